// KTX2: 2D array textures with one level, uncompressed.
import { DamagedBundle } from '../errors';
import type { Atlas, AtlasFormat } from './manifest';

const IDENTIFIER = [0xab, 0x4b, 0x54, 0x58, 0x20, 0x32, 0x30, 0xbb, 0x0d, 0x0a, 0x1a, 0x0a];
const FORMATS: Record<number, AtlasFormat> = { 145: 'bc7', 37: 'uint8', 97: 'fp16' };
const BLOCK: Record<AtlasFormat, { side: number; bytes: number }> = {
  bc7: { side: 4, bytes: 16 },
  uint8: { side: 1, bytes: 4 },
  fp16: { side: 1, bytes: 8 },
};

export interface Pages {
  format: AtlasFormat;
  width: number;
  height: number;
  layers: Uint8Array[];
}

const MOST_COLOR = 0x5c00; // 256 as fp16: RESIDUAL_LIMIT of codec/limits.py
const MOST_ALPHA = 0x4000; // 2
const MINUS_ZERO = 0x8000;

// Returns the index of the first number that exceeds the limits or is NaN, else -1.
function firstBeyond(texels: Uint8Array, alpha: boolean): number {
  const even = texels.byteOffset % 2 ? texels.slice() : texels;
  const halves = new Uint16Array(even.buffer, even.byteOffset, even.byteLength / 2);
  return halves.findIndex((bits, i) =>
    alpha && i % 4 === 3 ? bits > MOST_ALPHA && bits !== MINUS_ZERO : (bits & 0x7fff) > MOST_COLOR,
  );
}

export const blockOf = (format: AtlasFormat): { side: number; bytes: number } => BLOCK[format];

export function parseKtx2(data: ArrayBuffer, stated: Atlas): Pages {
  const view = new DataView(data);
  if (data.byteLength < 104 || IDENTIFIER.some((byte, i) => view.getUint8(i) !== byte)) {
    throw new DamagedBundle('atlas.ktx2 is not a KTX2 file.');
  }
  const word = (at: number): number => view.getUint32(at, true);
  const [width, height, layers, levels, scheme] = [word(20), word(24), word(32), word(40), word(44)];
  const format = FORMATS[word(12)];
  if (format !== stated.format || width !== stated.width || height !== stated.height || layers !== stated.layers) {
    throw new DamagedBundle('atlas.ktx2: format and size are not those of bundle.json.');
  }
  const { side, bytes } = BLOCK[format];
  const size = Math.ceil(width / side) * Math.ceil(height / side) * bytes;
  const at = Number(view.getBigUint64(80, true));
  const length = Number(view.getBigUint64(88, true));
  if (levels !== 1 || at + length > data.byteLength) throw new DamagedBundle('atlas.ktx2 is truncated.');
  if (scheme !== 0) throw new DamagedBundle(`atlas.ktx2 is compressed by a scheme (${scheme}) that is not known.`);
  const texels = new Uint8Array(data, at, length);
  if (texels.byteLength !== size * layers) throw new DamagedBundle('atlas.ktx2 has not the bytes of its texels.');
  const beyond = format === 'fp16' ? firstBeyond(texels, stated.alphaScale > 0) : -1;
  if (beyond >= 0) throw new DamagedBundle(`atlas.ktx2: texel ${beyond >> 2} is beyond the limits, or is no number.`);
  const pages = Array.from({ length: layers }, (_, k) => texels.subarray(k * size, (k + 1) * size));
  return { format, width, height, layers: pages };
}
