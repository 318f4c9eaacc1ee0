import { describe, expect, it } from 'vitest';
import { pack } from '../src/bundle/compact/packing';
import { readCompactSurfels } from '../src/bundle/compact/surfels';
import { readCompactTexels } from '../src/bundle/compact/texels';
import { parseManifest } from '../src/bundle/manifest';
import { KINDS, LEAN_WIDTH, SURFEL_WORDS, WORD, alphaIn, layerIn } from '../src/bundle/surfels';
import { frameBytes } from '../src/bundle/zstd';
import { DamagedBundle } from '../src/errors';
import { BUNDLES, PLANES, type Written, bytes, floats, frameOf, ints } from './compact_bundles';

const textOf = (data: Uint8Array): string => new TextDecoder().decode(data);

const WRITTEN: [string, string, Written][] = [
  ...Object.entries(BUNDLES).map(([name, of]): [string, string, Written] => [name, '5.0', of]),
  ['alpha', '4.0', PLANES.alpha],
  ['sg', '3.0', PLANES.sg],
];

describe.each(WRITTEN)('the compact bundle %s of version %s', (_, version, { files, scene }) => {
  const info = parseManifest(textOf(bytes(files['bundle.json'])));
  const surfels = readCompactSurfels(bytes(files['surfels.bin']), info);
  const numbers = new Uint32Array(surfels.words.buffer);

  const compare = (key: string, word: number, width: number, offset = [0, 0, 0]): void => {
    const want = floats(scene[key]);
    expect(want.length).toBe(info.count * width);
    want.forEach((value, at) => {
      const found = surfels.words[Math.floor(at / width) * SURFEL_WORDS + word + (at % width)];
      const off = Math.abs(found + (offset[at % width] ?? 0) - value);
      expect(off, `${key} ${at}`).toBeLessThanOrEqual(1e-6 * Math.max(1, Math.abs(value)));
    });
  };

  it('has the numbers that the package reads', () => {
    expect(info.version).toBe(version);
    expect([surfels.count, surfels.kind, surfels.means]).toEqual([info.count, KINDS[info.viewColor], true]);
    compare('means', WORD.mean, 3, surfels.origin);
    compare('quats', WORD.quat, 4);
    compare('log_scales', WORD.logScale, 2);
    compare('opacity_logits', WORD.opacity, 1);
    compare('beta_raw', WORD.beta, 1);
    compare('view_base', WORD.base, 3);
    compare('mean_residual', WORD.residual, 3);
    compare('extent', WORD.extent, 1);
    const want = floats(scene.view_terms);
    expect(surfels.terms.length).toBe(want.length);
    want.forEach((x, i) => expect(Math.abs(surfels.terms[i] - x)).toBeLessThanOrEqual(1e-6 * Math.max(1, Math.abs(x))));
  });

  it('has the tiles and terms that the package finds, exactly', () => {
    const [tiles, span] = [ints(scene.tiles), ints(scene.view_span)];
    for (let i = 0; i < info.count; i++) {
      const row = i * SURFEL_WORDS;
      const sides = numbers[row + WORD.sides];
      const [x, y, word] = [WORD.tile, WORD.tile + 1, WORD.layer].map((at) => numbers[row + at]);
      if ('mean_alpha' in scene) expect(alphaIn(word)).toBe(floats(scene.mean_alpha)[i]);
      expect([x, y, layerIn(word), sides & 0xffff, sides >>> 16]).toEqual([...tiles.subarray(5 * i, 5 * i + 5)]);
      const first = numbers[row + WORD.firstTerm] / LEAN_WIDTH[info.viewColor];
      expect([first, numbers[row + WORD.terms]]).toEqual([...span.subarray(2 * i, 2 * i + 2)]);
    }
  });

  it.runIf('mean_alpha' in scene)('has alphas of their own step, whatever that of the colours is', () => {
    const { coded, ...atlas } = info.atlas!;
    const alphas = (step: number): number[] => {
      const pages = readCompactTexels(bytes(files['texels.bin']), { ...atlas, coded: { ...coded!, step } }, surfels);
      return [...Buffer.concat(pages.layers)].filter((_, at) => at % 4 === 3);
    };
    expect(alphas(2 * coded!.step)).toEqual(alphas(coded!.step));
  });

  it.runIf('atlas' in scene)('has the texels that the package decodes', () => {
    const pages = readCompactTexels(bytes(files['texels.bin']), info.atlas!, surfels);
    const want = bytes(scene.atlas);
    const found = Buffer.concat(pages.layers);
    expect(found.length).toBe(want.length);
    let others = 0;
    want.forEach((value, at) => {
      // the package sums in single precision: ties between two bytes may go either way
      expect(Math.abs(found[at] - value)).toBeLessThanOrEqual(1);
      if (found[at] !== value) others++;
    });
    expect(others).toBeLessThanOrEqual(want.length / 10_000);
  });
});

describe('packing', () => {
  it('goes on in the shelves that have room, and in further pages', () => {
    const sides = [64, 8, 8, 4, 64, 64];
    const packed = pack(Uint16Array.from(sides), Uint16Array.from(sides), 64, 64);
    expect([packed.width, packed.height, packed.layers]).toEqual([64, 64, 4]);
    expect([...packed.layer]).toEqual([0, 3, 3, 3, 1, 2]);
    expect([...packed.x]).toEqual([0, 0, 8, 16, 0, 0]);
  });
  it('refuses tiles that are wider than a page', () => {
    expect(() => pack(Uint16Array.of(64), Uint16Array.of(64), 32, 64)).toThrowError(DamagedBundle);
  });
});

describe('a Zstandard frame', () => {
  const content = Uint8Array.from({ length: 1000 }, (_, i) => i & 7);
  it('is decoded where it has the size that is wanted', () => {
    expect([...frameBytes(frameOf(content), 1000, 'x')]).toEqual([...content]);
  });
  it('of 2^28 bytes is decoded, in the time that so many bytes take', () => {
    const [size, block] = [2 ** 28, 2 ** 17];
    const blocks = Array.from({ length: size / block }, (_, k) => {
      const head = (block << 3) | 2 | (k + 1 === size / block ? 1 : 0);
      return [head & 255, (head >> 8) & 255, head >> 16, k & 255];
    });
    const frame = Uint8Array.from([0x28, 0xb5, 0x2f, 0xfd, 0xa0, 0, 0, 0, 0x10, ...blocks.flat()]);
    const data = frameBytes(frame, size, 'x');
    expect([data.length, data[block], data[size - 1]]).toEqual([size, 1, 255]);
  });
  it('of no bytes takes no memory for a window', () => {
    const frame = [0x28, 0xb5, 0x2f, 0xfd, 0x80, 0xa0, 0, 0, 0, 0, 1, 0, 0]; // a window of a gigabyte
    expect(frameBytes(Uint8Array.from(frame), 0, 'x').buffer.byteLength).toBe(0);
  });
  it.each([
    ['of another size', frameOf(content.subarray(1))],
    [
      'that does not declare its size',
      Uint8Array.from([0x28, 0xb5, 0x2f, 0xfd, 0, 0x88, ...frameOf(content).slice(9)]),
    ],
    ['that ends early', frameOf(content).subarray(0, 500)],
    ['that something follows', Uint8Array.from([...frameOf(content), 0])],
    ['that is none', content],
  ])('%s is refused', (_, frame) => {
    expect(() => frameBytes(frame, 1000, 'x')).toThrowError(DamagedBundle);
  });
  it('whose table gives all to one symbol is refused: a reader that trusts it never ends', () => {
    expect(() => frameBytes(hanging(), 1000, 'x')).toThrowError(/a table says nothing/);
  });
});

// One compressed block: 1000 literals in one stream, whose table is a distribution of 32 over one symbol.
function hanging(): Uint8Array {
  const tree = [5, 0xf0, 0x03, 0xff, 0xff, 0x01];
  const packed = tree.length + 4;
  const literals = 2 + 1000 * 16 + packed * 2 ** 14;
  const block = [literals & 255, (literals >> 8) & 255, literals >> 16, ...tree, 1, 2, 3, 1, 0];
  const head = (block.length << 3) | 4 | 1;
  return Uint8Array.from([0x28, 0xb5, 0x2f, 0xfd, 0x60, 232, 2, head & 255, head >> 8, 0, ...block]);
}
