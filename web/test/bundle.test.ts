import { describe, expect, it } from 'vitest';
import { parseKtx2 } from '../src/bundle/ktx2';
import { parseManifest } from '../src/bundle/manifest';
import { readCompactSurfels } from '../src/bundle/compact/surfels';
import { alphaIn, layerIn, readSurfels } from '../src/bundle/surfels';
import { SURFEL_WORDS, WORD } from '../src/bundle/tables';
import { DamagedBundle, ViewerError } from '../src/errors';
import { EARLIER, bytes, floats } from './compact_bundles';

const HASH = 'a'.repeat(64);
const RENDER = { near: 0.1, weight_bound: 0.02, background: [0, 0, 0] };
const manifest = (changes: object = {}): string =>
  JSON.stringify({
    format: 'bitymi-bundle',
    version: '6.0',
    surfels: { count: 2, view_color: 'sv', terms: 1 },
    atlas: null,
    render: RENDER,
    bounds: { min: [0, 0, 0], max: [2, 2, 2] },
    files: { 'surfels.ply': { bytes: 1, sha256: HASH } },
    ...changes,
  });

const ATLAS = { format: 'uint8', width: 8, height: 8, layers: 2, offset: 0, scale: 1 };
const FLOATS = [
  ...['x', 'y', 'z', 'opacity', 'scale_0', 'scale_1', 'rot_0', 'rot_1', 'rot_2', 'rot_3', 'beta'],
  ...['view_base_0', 'view_base_1', 'view_base_2'],
];
const INTS = ['view_terms', 'tile_x', 'tile_y', 'tile_layer', 'tile_ru', 'tile_rv'];

function ply(rows: number[][], terms: number[][], floats = FLOATS): ArrayBuffer {
  const header = [
    'ply',
    'format binary_little_endian 1.0',
    'comment made by a test',
    `element vertex ${rows.length}`,
    ...floats.map((name) => `property float ${name}`),
    ...INTS.map((name) => `property int ${name}`),
    `element view_term ${terms.length}`,
    ...[0, 1, 2, 3, 4, 5].map((k) => `property float term_${k}`),
    'end_header\n',
  ].join('\n');
  const head = new TextEncoder().encode(header);
  const words = floats.length + INTS.length;
  const data = new DataView(new ArrayBuffer(head.length + 4 * (rows.length * words + terms.length * 6)));
  head.forEach((byte, i) => data.setUint8(i, byte));
  let at = head.length;
  for (const row of rows) {
    row.forEach((value, k) => {
      if (k < floats.length) data.setFloat32(at, value, true);
      else data.setInt32(at, value, true);
      at += 4;
    });
  }
  for (const row of terms) for (const value of row) data.setFloat32((at += 4) - 4, value, true);
  return data.buffer;
}
const row = (x: number, terms: number): number[] => [
  x,
  1,
  1,
  0.5,
  -1,
  -2,
  1,
  0,
  0,
  0,
  2,
  0.1,
  0.2,
  0.3,
  terms,
  0,
  0,
  0,
  0,
  0,
];

describe('bundle.json', () => {
  it('is read', () => {
    const info = parseManifest(manifest());
    expect(info.count).toBe(2);
    expect(info.files.get('surfels.ply')?.bytes).toBe(1);
  });
  it('of a newer major version is refused, with what to do', () => {
    expect(() => parseManifest(manifest({ version: '7.0' }))).toThrowError(/version 7.0/);
    try {
      parseManifest(manifest({ version: '7.1' }));
    } catch (error) {
      expect((error as ViewerError).advice).toMatch(/Update/);
    }
  });
  it.each([
    ['not json', '{'],
    ['a number out of range', manifest({ render: { near: 0, weight_bound: 0, background: [0, 0, 0] } })],
    ['a prefilter of its own', manifest({ render: { ...RENDER, prefilter: 'pixel' } })],
    ['a kind that is none', manifest({ surfels: { count: 1, view_color: 'xx' } })],
    ['a count that is no whole number', manifest({ surfels: { count: 1.5, view_color: 'sv' } })],
    ['files that are no objects', manifest({ files: { 'surfels.ply': 3 } })],
  ])('with %s is refused', (_, text) => {
    expect(() => parseManifest(text)).toThrowError(DamagedBundle);
  });
  it.each(['1.3', '2.2', '3.0', '5.0'])('of version %s with surfels.ply is refused: export it again', (version) => {
    expect(() => parseManifest(manifest({ version }))).toThrowError(/read no longer|has version/);
  });
  it('of something else is refused', () => {
    expect(() => parseManifest('{"format":"x"}')).toThrowError(ViewerError);
  });
});

const changed = (from: string, to: string): ArrayBuffer => {
  const text = new TextDecoder('latin1').decode(ply([row(0, 0), row(2, 1)], [[1, 2, 3, 4, 5, 6]]));
  return Uint8Array.from(text.replace(from, to), (c) => c.charCodeAt(0)).buffer;
};

describe('surfels.ply', () => {
  const info = parseManifest(manifest());
  it('is packed as the shaders read it', () => {
    const data = ply([row(0, 0), row(2, 1)], [[1, 2, 3, 4, 5, 6]]);
    const { words, terms, kind, origin } = readSurfels(data, info);
    const numbers = new Uint32Array(words.buffer);
    expect(origin).toEqual([1, 1, 1]);
    expect([words[0], words[1], words[SURFEL_WORDS]]).toEqual([-1, 0, 1]);
    expect(words[11]).toBe(3);
    expect(kind).toBe(0);
    expect([...terms]).toEqual([1, 2, 3, 4, 5, 6]);
    expect([numbers[SURFEL_WORDS + 19], numbers[SURFEL_WORDS + 23]]).toEqual([0, 1]);
  });
  it.each([
    ['truncated', ply([row(0, 0), row(2, 1)], [[1, 2, 3, 4, 5, 6]]).slice(0, -4)],
    ['of another number of surfels', ply([row(0, 1)], [[1, 2, 3, 4, 5, 6]])],
    ['with terms that are not counted', ply([row(0, 0), row(2, 0)], [[1, 2, 3, 4, 5, 6]])],
    ['with a number that is not finite', ply([row(0, 0), row(NaN, 1)], [[1, 2, 3, 4, 5, 6]])],
    ['that is something else', new ArrayBuffer(64)],
    ['with a count below 0', changed('vertex 2', 'vertex -2')],
    ['with a count that is no number', changed('vertex 2', 'vertex 2e0')],
    ['with a property twice', changed('float y', 'float x')],
    ['with an element twice', changed('element view_term', 'element vertex')],
  ])('%s is refused', (_, data) => {
    expect(() => readSurfels(data, info)).toThrowError(DamagedBundle);
  });
  it('with alphas has them beside the layers of the tiles', () => {
    const atlas = { ...ATLAS, alpha_scale: 255 / 128 };
    const about = parseManifest(manifest({ atlas }));
    const rows = (second: number): ArrayBuffer => {
      const each = [0.5, second].map((alpha, i) => [...row(i, 0).slice(0, FLOATS.length), alpha, 0, 0, 0, i, 4, 4]);
      return ply(each, [], [...FLOATS, 'alpha']);
    };
    const { words } = readSurfels(rows(2), about);
    const found = [0, SURFEL_WORDS].map((at) => new Uint32Array(words.buffer)[at + WORD.layer]);
    expect(found.map((word) => [layerIn(word), alphaIn(word)])).toEqual([
      [0, 0.5],
      [1, 255 / 128],
    ]);
    for (const bad of [-0.1, 2.1, NaN]) expect(() => readSurfels(rows(bad), about)).toThrowError(/alpha .* in row 1/);
    expect(() => readSurfels(ply([row(0, 0), row(2, 0)], []), about)).toThrowError(DamagedBundle);
  });
  it('with a tile outside of the atlas is refused', () => {
    const bad = row(0, 0);
    bad[FLOATS.length + 4] = 4;
    bad[FLOATS.length + 5] = 4;
    expect(() => readSurfels(ply([bad, row(2, 1)], [[1, 2, 3, 4, 5, 6]]), info)).toThrowError(/tile of surfel 0/);
  });
});

describe('atlas.ktx2', () => {
  it('that is something else is refused', () => {
    const atlas = {
      format: 'bc7',
      width: 4,
      height: 4,
      layers: 1,
      extent: 3,
      offset: 0,
      scale: 1,
      alphaScale: 0,
      coded: null,
    } as const;
    expect(() => parseKtx2(new ArrayBuffer(200), atlas)).toThrowError(DamagedBundle);
  });
});

describe.each(Object.entries(EARLIER))('the stored bundle of version %s', (version, { files, scene }) => {
  const info = parseManifest(new TextDecoder().decode(bytes(files['bundle.json'])));
  const surfels = info.compact
    ? readCompactSurfels(bytes(files['surfels.bin']), info)
    : readSurfels(bytes(files['surfels.ply']).buffer as ArrayBuffer, info);
  it('opens with the numbers that the package reads', () => {
    expect(info.version).toBe(version);
    const [means, alphas] = [floats(scene.means), 'mean_alpha' in scene ? floats(scene.mean_alpha) : null];
    const numbers = new Uint32Array(surfels.words.buffer);
    for (let i = 0; i < info.count; i++) {
      const at = i * SURFEL_WORDS;
      for (let c = 0; c < 3; c++) {
        expect(surfels.words[at + c] + surfels.origin[c]).toBeCloseTo(means[3 * i + c], 5);
      }
      if (alphas) expect(alphaIn(numbers[at + WORD.layer])).toBe(alphas[i]);
    }
    if (files['atlas.ktx2']) {
      const pages = parseKtx2(bytes(files['atlas.ktx2']).buffer as ArrayBuffer, info.atlas!);
      if (info.atlas!.format === 'uint8') expect(Buffer.concat(pages.layers).equals(bytes(scene.atlas))).toBe(true);
    }
  });
});
