// What ktx-parse reads of a KTX2 file: node read_ktx2.mjs NODE_MODULES FILE
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { pathToFileURL } from 'node:url';

const [modules, file] = process.argv.slice(2);
const found = createRequire(`${modules}/`).resolve('ktx-parse');
const { read } = await import(pathToFileURL(found));
const { levels, ...rest } = read(new Uint8Array(readFileSync(file)));
const [level] = levels;
console.log(
  JSON.stringify({
    ...rest,
    levels: levels.length,
    uncompressed: level.uncompressedByteLength,
    data: Buffer.from(level.levelData).toString('base64'),
  }),
);
