// Small compact bundles and their contents as the package reads them, written by compact_bundles.py.
import { readFileSync } from 'node:fs';

export interface Written {
  files: Record<string, string>;
  scene: Record<string, string>;
}

const read = (file: string): Record<string, Written> =>
  JSON.parse(readFileSync(new URL(file, import.meta.url), 'utf8')) as Record<string, Written>;
export const BUNDLES = read('compact.json');
export const PLANES = read('compact_planes.json'); // of versions 3 and 4: Zstandard frames
export const bytes = (text: string): Uint8Array => Uint8Array.from(Buffer.from(text, 'base64'));
export const floats = (text: string): Float32Array => new Float32Array(bytes(text).buffer);
export const ints = (text: string): Int32Array => new Int32Array(bytes(text).buffer);

// Builds a Zstandard frame with raw bytes.
export function frameOf(content: Uint8Array): Uint8Array {
  const out = [0x28, 0xb5, 0x2f, 0xfd, 0xa0, ...[0, 8, 16, 24].map((shift) => (content.length >>> shift) & 255)];
  for (let at = 0; at < content.length || at === 0; at += 1 << 17) {
    const part = content.subarray(at, at + (1 << 17));
    const head = (part.length << 3) | (at + part.length >= content.length ? 1 : 0);
    out.push(head & 255, (head >> 8) & 255, head >> 16, ...part);
  }
  return Uint8Array.from(out);
}
