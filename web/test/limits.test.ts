import { describe, expect, it } from 'vitest';
import { readCompactSurfels } from '../src/bundle/compact/surfels';
import { readCompactTexels } from '../src/bundle/compact/texels';
import { type Manifest, parseManifest } from '../src/bundle/manifest';
import { DamagedBundle, reasonOf } from '../src/errors';
import { type Limits, checkRoom, pageBytes } from '../src/render/limits';
import { BUNDLES, bytes } from './compact_bundles';

const { files } = BUNDLES.sv;
const info = parseManifest(new TextDecoder().decode(bytes(files['bundle.json'])));
const atlas = info.atlas!;
const ROOMY: Limits = {
  maxStorageBufferBindingSize: 2 ** 31,
  maxBufferSize: 2 ** 31,
  maxComputeWorkgroupsPerDimension: 65535,
  maxTextureDimension2D: 8192,
  maxTextureArrayLayers: 256,
};
const larger = (changes: Partial<Manifest>): Manifest => ({ ...info, ...changes });

describe('a scene', () => {
  it('that fits is let pass', () => expect(() => checkRoom(info, ROOMY)).not.toThrow());
  it.each([
    ['more pages than a texture has', larger({ atlas: { ...atlas, layers: 300 } }), {}],
    ['a wider page', larger({ atlas: { ...atlas, width: 8196 } }), {}],
    ['a higher page', larger({ atlas: { ...atlas, height: 8196 } }), {}],
    ['more surfels than threads are started for', larger({ count: 64 * 65535 + 1 }), {}],
    ['more surfels than a buffer holds', info, { maxBufferSize: 96 * info.count - 1 }],
    ['more terms than a buffer is bound with', larger({ terms: 100 }), { maxStorageBufferBindingSize: 2399 }],
    ['more than half of the memory', larger({ count: 4_000_000 }), { gigabytes: 1 }],
    ['more texels than half of the memory', larger({ atlas: { ...atlas, width: 8192, height: 8192, layers: 8 } }), {}],
  ])(
    'with %s is refused with its sizes',
    (_, large, { gigabytes, ...lower }: Partial<Limits & { gigabytes: number }>) => {
      try {
        checkRoom(large, { ...ROOMY, ...lower }, gigabytes);
        expect.unreachable();
      } catch (error) {
        const { title, message, advice } = reasonOf(error);
        expect(title).toMatch(/too large for this device/);
        expect(message).toMatch(/[\d,]+ surfels, \d+ pages? of \d+ x \d+ texels/);
        expect(advice).toMatch(/more memory/);
      }
    },
  );
  it('of a few kilobytes is never said to hold what takes gigabytes', () => {
    const data = bytes(files['surfels.bin']);
    const most = data.length + 4096;
    expect(() => readCompactSurfels(data, larger({ count: most + 1 }))).toThrowError(/surfels cannot be in/);
    expect(() => readCompactSurfels(data, larger({ terms: most + 1 }))).toThrowError(/surfels cannot be in/);
    expect(pageBytes(larger({ count: most, terms: most }))).toBeLessThan(500 * data.length + 2_000_000);
    const texels = bytes(files['texels.bin']);
    const room = 64 * (data.length + texels.length) + 2 ** 20;
    const surfels = readCompactSurfels(data, info);
    const wide = { ...atlas, width: room + 1, height: 1, layers: 1 };
    expect(() => readCompactTexels(texels, wide, surfels)).toThrowError(DamagedBundle);
  });
  it('for which there is no memory is too large, whatever says so', () => {
    expect(reasonOf(new RangeError('Array buffer allocation failed')).title).toMatch(/too large/);
  });
});
