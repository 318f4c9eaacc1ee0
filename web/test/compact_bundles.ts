// Small compact bundles and their contents as the package reads them, written by compact_bundles.py.
import { readFileSync } from 'node:fs';

export interface Written {
  files: Record<string, string>;
  scene: Record<string, string>;
}

const read = (file: string): Record<string, Written> =>
  JSON.parse(readFileSync(new URL(file, import.meta.url), 'utf8')) as Record<string, Written>;
export const BUNDLES = read('compact.json');
export const EARLIER = read('earlier_bundles.json'); // by version, as it wrote them
export const bytes = (text: string): Uint8Array => Uint8Array.from(Buffer.from(text, 'base64'));
export const floats = (text: string): Float32Array => new Float32Array(bytes(text).buffer);
export const ints = (text: string): Int32Array => new Int32Array(bytes(text).buffer);
