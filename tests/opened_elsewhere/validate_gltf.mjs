// What Khronos's validator finds in a binary glTF file: node validate_gltf.mjs NODE_MODULES FILE
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';

const [modules, file] = process.argv.slice(2);
const { validateBytes } = createRequire(`${modules}/`)('gltf-validator');
const { issues, info } = await validateBytes(new Uint8Array(readFileSync(file)));
console.log(JSON.stringify({ issues, info }));
