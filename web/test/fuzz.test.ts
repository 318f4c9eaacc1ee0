// Damaged compact bundles with valid hashes give, in a short time, an error that names the damage, or numbers within
// the limits. VIEWER_FUZZ=10 makes ten times as many.
import { expect, it } from 'vitest';
import { readCompactSurfels } from '../src/bundle/compact/surfels';
import { readCompactTexels } from '../src/bundle/compact/texels';
import { parseManifest } from '../src/bundle/manifest';
import { layerIn } from '../src/bundle/surfels';
import { SURFEL_WORDS, WORD } from '../src/bundle/tables';
import { DamagedBundle } from '../src/errors';
import { BUNDLES, bytes } from './compact_bundles';

const EXAMPLES = 4000 * Number(process.env.VIEWER_FUZZ ?? 1);
const MOST_TIME = 2000; // milliseconds per bundle
const LIMITS: [number, number, number][] = [
  // first word, words, largest size
  [WORD.mean, 3, 2.1e9],
  [WORD.opacityLogit, 1, 1e4],
  [WORD.quat, 4, 1.0001],
  [WORD.logScale, 2, 104],
  [WORD.betaRaw, 1, 1e4],
  [WORD.extent, 1, 16],
  [WORD.residual, 3, 256],
  [WORD.base, 3, 256],
];

// Random numbers from 0 to 1, the same on every machine.
function draws(seed: number): () => number {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let x = Math.imul(state ^ (state >>> 15), 1 | state);
    x = (x + Math.imul(x ^ (x >>> 7), 61 | x)) ^ x;
    return ((x ^ (x >>> 14)) >>> 0) / 2 ** 32;
  };
}

type Json = Record<string, unknown>;
interface Described {
  surfels: Json & { frame: Json; columns: Row[] };
  atlas: Json & { columns: Row[] };
}
type Row = Json & { bytes: number[] };
type Files = Record<'surfels.bin' | 'texels.bin', Uint8Array>;

class Vandal {
  constructor(readonly next: () => number) {}
  below(count: number): number {
    return Math.floor(this.next() * count);
  }
  of<T>(list: readonly T[]): T {
    return list[this.below(list.length)];
  }

  flip(_: Described, files: Files): void {
    const data = files[this.of(['surfels.bin', 'texels.bin'] as const)];
    for (let k = this.of([1, 1, 3, 20]); k; k--) data[this.below(data.length)] ^= 1 << this.below(8);
  }

  // Replaces a number of a column by another one, or by random bytes.
  swap(info: Described, files: Files): void {
    const numbers: [keyof Files, number[], number, Uint8Array][] = [];
    for (const [name, { columns }] of [['surfels.bin', info.surfels] as const, ['texels.bin', info.atlas] as const]) {
      let at = 0;
      for (const { bytes } of columns) {
        bytes.forEach((size, k) => numbers.push([name, bytes, k, files[name].subarray(at, (at += size))]));
      }
    }
    const [name, sizes, k, old] = this.of(numbers);
    const from = old.byteOffset - files[name].byteOffset;
    const random = Uint8Array.from({ length: this.of([1, old.length, 100]) }, () => this.below(256));
    const data = this.next() < 0.2 ? random : this.of(numbers)[3];
    files[name] = Uint8Array.from([
      ...files[name].subarray(0, from),
      ...data,
      ...files[name].subarray(from + old.length),
    ]);
    sizes[k] = data.length;
  }

  misstate(info: Described): void {
    const { surfels, atlas } = info;
    const places: [Json, string][] = [
      ...['count', 'terms'].map((key): [Json, string] => [surfels, key]),
      ...[
        'texels',
        'step',
        'width',
        'height',
        'layers',
        'page_width',
        'page_rows',
        'offset',
        'scale',
        'alpha_scale',
      ].map((key): [Json, string] => [atlas, key]),
      [surfels.frame, 'scale'],
    ];
    for (const column of [...surfels.columns, ...atlas.columns]) {
      places.push([column, 'step']);
      column.bytes.forEach((_, k) => places.push([column.bytes as unknown as Json, `${k}`]));
    }
    const [at, key] = this.of(places);
    const values = [0, 1, -1, 2, 5, 255, 2 ** 20, 2 ** 31, -(2 ** 40), 2 ** 40, 1e-9, 1e6, 1e300, -99, null];
    const old = at[key];
    at[key] = this.of(typeof old === 'number' ? [...values, old * 2, old + 1] : values);
  }
}

function hold(good: boolean): void {
  if (!good) throw new Error('a number is beyond its limits');
}

// Returns true if the damaged bundle opens.
function opens(info: Described, files: Files): boolean {
  try {
    const manifest = parseManifest(JSON.stringify(info));
    const surfels = readCompactSurfels(files['surfels.bin'], manifest);
    const pages = readCompactTexels(files['texels.bin'], manifest.atlas!, surfels);
    const { width, height, layers } = manifest.atlas!;
    const numbers = new Uint32Array(surfels.words.buffer);
    for (let row = 0; row < surfels.words.length; row += SURFEL_WORDS) {
      for (const [word, count, most] of LIMITS) {
        for (let c = 0; c < count; c++) hold(Math.abs(surfels.words[row + word + c]) <= most);
      }
      const sides = numbers[row + WORD.sides];
      hold(numbers[row + WORD.tile] + (sides & 0xffff) <= width);
      hold(numbers[row + WORD.tile + 1] + (sides >>> 16) <= height);
      hold(layerIn(numbers[row + WORD.layer]) < layers);
      hold(numbers[row + WORD.firstTerm] + 6 * numbers[row + WORD.terms] <= surfels.terms.length);
    }
    hold(surfels.terms.every((x) => Math.abs(x) <= 2e7));
    hold(pages.layers.every((page) => page.length === 4 * width * height));
    return true;
  } catch (error) {
    if (!(error instanceof DamagedBundle)) throw error;
    hold(error.message !== '');
    return false;
  }
}

it(`${EXAMPLES} damaged bundles are refused, or have numbers within their limits`, () => {
  const { files } = BUNDLES.alpha;
  const vandal = new Vandal(draws(1));
  const text = new TextDecoder().decode(bytes(files['bundle.json']));
  let [found, slowest] = [0, 0];
  for (let k = 0; k < EXAMPLES; k++) {
    const info = JSON.parse(text) as Described;
    const data = { 'surfels.bin': bytes(files['surfels.bin']), 'texels.bin': bytes(files['texels.bin']) };
    for (let times = vandal.of([1, 1, 1, 2, 5]); times; times--) {
      const how = vandal.below(4);
      if (how === 0) vandal.flip(info, data);
      else if (how === 3) vandal.misstate(info);
      else vandal.swap(info, data);
    }
    const begin = performance.now();
    if (opens(info, data)) found++;
    slowest = Math.max(slowest, performance.now() - begin);
  }
  console.log(`${found} of ${EXAMPLES} damaged bundles open; the slowest took ${slowest.toFixed(0)} ms`);
  expect(slowest).toBeLessThan(MOST_TIME);
  expect(found).toBeGreaterThan(0.05 * EXAMPLES);
  expect(found).toBeLessThan(0.95 * EXAMPLES);
}, 120_000);
