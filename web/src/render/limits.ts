// Limits of the device, checked before a scene is decoded.
import type { Atlas, Manifest } from '../bundle/manifest';
import { REDUCED_WIDTH, SURFEL_WORDS } from '../bundle/tables';
import { tooLarge } from '../errors';

const DECODED_NUMBERS = 19; // doubles per surfel while a compact bundle is decoded, without terms
const TEXEL_BYTES = 12; // per texel while decoding: three coefficients
const GIGABYTE = 2 ** 30;
const UNKNOWN_MEMORY = 4; // gigabytes, if the browser does not tell
const SHARE = 0.5; // of the device's memory for a page
export const GROUP = 64; // surfels per workgroup of prepare.wgsl

export type Limits = Pick<
  GPUSupportedLimits,
  | 'maxStorageBufferBindingSize'
  | 'maxBufferSize'
  | 'maxComputeWorkgroupsPerDimension'
  | 'maxTextureDimension2D'
  | 'maxTextureArrayLayers'
>;

const texelsOf = (atlas: Atlas): number => atlas.width * atlas.height * atlas.layers;

// Estimates the page's peak memory, bytes, from below.
export function pageBytes({ count, terms, viewColor, compact, atlas, files }: Manifest): number {
  const width = REDUCED_WIDTH[viewColor];
  const words = 4 * (SURFEL_WORDS * count + width * (terms ?? 0));
  if (compact) {
    const decoded = 8 * (DECODED_NUMBERS * count + width * (terms ?? 0));
    const pages = atlas ? TEXEL_BYTES * (atlas.coded?.texels ?? 0) + 8 * texelsOf(atlas) : 0;
    return words + Math.max(decoded, pages);
  }
  return words + ['surfels.ply', 'atlas.ktx2'].reduce((sum, name) => sum + (files.get(name)?.bytes ?? 0), 0);
}

export function checkRoom(info: Manifest, limits: Limits, gigabytes = UNKNOWN_MEMORY): void {
  const { count, terms, viewColor, atlas } = info;
  const largest = Math.max(4 * SURFEL_WORDS * count, 4 * REDUCED_WIDTH[viewColor] * (terms ?? 0));
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
