import { describe, expect, it } from 'vitest';
import { pack } from '../src/bundle/compact/packing';
import { readCompactSurfels } from '../src/bundle/compact/surfels';
import { readCompactTexels } from '../src/bundle/compact/texels';
import { parseManifest } from '../src/bundle/manifest';
import { alphaIn, layerIn } from '../src/bundle/surfels';
import { KINDS, REDUCED_WIDTH, SURFEL_WORDS, WORD } from '../src/bundle/tables';
import { DamagedBundle } from '../src/errors';
import { BUNDLES, EARLIER, type Written, bytes, floats, ints } from './compact_bundles';

const textOf = (data: Uint8Array): string => new TextDecoder().decode(data);

const WRITTEN: [string, string, Written][] = [
  ...Object.entries(BUNDLES).map(([name, of]): [string, string, Written] => [name, '6.0', of]),
  ['alpha', '5.0', EARLIER['5.0']],
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
    compare('opacity_logits', WORD.opacityLogit, 1);
    compare('beta_raw', WORD.betaRaw, 1);
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
      const first = numbers[row + WORD.firstTerm] / REDUCED_WIDTH[info.viewColor];
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
