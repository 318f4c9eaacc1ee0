// Pictures of a bundle's first view: the poster until the surfels arrive, the preview where nothing can draw.
import { MOST_BESIDE, readPart } from './load';
import type { Manifest } from './manifest';
import type { Source } from './source';

export const POSTER = 'poster.webp';
const MOST_BYTES = 1 << 20;
const MOST_SIDE = 1024;
const HEADER = 30;

const letters = (view: DataView, at: number): string =>
  String.fromCharCode(...[0, 1, 2, 3].map((k) => view.getUint8(at + k)));

// Lossy WebP pictures of a poster's size alone are handed to the browser.
export function isPoster(data: ArrayBuffer): boolean {
  const view = new DataView(data);
  if (data.byteLength < HEADER) return false;
  if (letters(view, 0) !== 'RIFF' || letters(view, 8) !== 'WEBP' || letters(view, 12) !== 'VP8 ') return false;
  if (view.getUint32(4, true) + 8 !== data.byteLength) return false;
  const sides = [26, 28].map((at) => view.getUint16(at, true)); // rejects scaling, in the two highest bits
  return sides.every((side) => side >= 1 && side <= MOST_SIDE);
}

// Reads a file of at most `most` bytes; null if missing or damaged.
async function read(source: Source, info: Manifest, name: string, most: number): Promise<ArrayBuffer | null> {
  if ((info.files.get(name)?.bytes ?? Infinity) > most) return null;
  return readPart(source, info, name, () => undefined).catch(() => null);
}

export async function loadPoster(source: Source, info: Manifest): Promise<Blob | null> {
  const data = await read(source, info, POSTER, MOST_BYTES);
  return data && isPoster(data) ? new Blob([data], { type: 'image/webp' }) : null;
}

export async function loadPreview(source: Source, info: Manifest): Promise<Blob | null> {
  const fits = (name: string) => (info.files.get(name)?.bytes ?? Infinity) <= MOST_BESIDE;
  const [name, type] = fits('preview.jpg') ? ['preview.jpg', 'image/jpeg'] : ['preview.png', 'image/png'];
  const data = await read(source, info, name, MOST_BESIDE);
  return data && new Blob([data], { type });
}
