// What a device has room for, asked before anything of a scene is decoded or made.
import type { Atlas, Manifest } from '../bundle/manifest';
import { LEAN_WIDTH, SURFEL_WORDS } from '../bundle/surfels';
import { tooLarge } from '../errors';

const DECODED_NUMBERS = 19; // of a surfel of a compact bundle, besides its terms: doubles, all at once
const TEXEL_BYTES = 12; // of a texel on its way: three coefficients
const GIGABYTE = 2 ** 30;
const UNKNOWN_MEMORY = 4; // gigabytes, where the browser does not say how many the device has
const SHARE = 0.5; // of them, that a page may take
const GROUP = 64; // surfels: prepare.wgsl

export type Limits = Pick<
  GPUSupportedLimits,
  | 'maxStorageBufferBindingSize'
  | 'maxBufferSize'
  | 'maxComputeWorkgroupsPerDimension'
  | 'maxTextureDimension2D'
  | 'maxTextureArrayLayers'
>;

const texelsOf = (atlas: Atlas): number => atlas.width * atlas.height * atlas.layers;

// Bytes that the page takes at its peak, at least.
export function pageBytes({ count, terms, viewColor, compact, atlas, files }: Manifest): number {
  const width = LEAN_WIDTH[viewColor];
  const words = 4 * (SURFEL_WORDS * count + width * (terms ?? 0));
  if (compact) {
    const decoded = 8 * (DECODED_NUMBERS * count + width * (terms ?? 0));
    const pages = atlas ? TEXEL_BYTES * (atlas.coded?.texels ?? 0) + 8 * texelsOf(atlas) : 0;
    return words + Math.max(decoded, pages);
  }
  return words + ['surfels.ply', 'atlas.ktx2'].reduce((sum, name) => sum + (files.get(name)?.bytes ?? 0), 0);
}

// Refuses a scene that bundle.json says to be larger than the device takes.
export function checkRoom(info: Manifest, limits: Limits, gigabytes = UNKNOWN_MEMORY): void {
  const { count, terms, viewColor, atlas } = info;
  const largest = Math.max(4 * SURFEL_WORDS * count, 4 * LEAN_WIDTH[viewColor] * (terms ?? 0));
  const side = atlas ? Math.max(atlas.width, atlas.height) : 0;
  const layers = atlas?.layers ?? 0;
  const fits =
    largest <= Math.min(limits.maxStorageBufferBindingSize, limits.maxBufferSize) &&
    count <= GROUP * limits.maxComputeWorkgroupsPerDimension &&
    side <= limits.maxTextureDimension2D &&
    layers <= limits.maxTextureArrayLayers &&
    pageBytes(info) <= SHARE * gigabytes * GIGABYTE;
  if (fits) return;
  const pages = atlas
    ? `, ${layers} ${layers === 1 ? 'page' : 'pages'} of ${atlas.width} x ${atlas.height} texels`
    : '';
  throw tooLarge(`It has ${count.toLocaleString('en')} surfels${pages}.`);
}
