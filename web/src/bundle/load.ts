// Fetches a bundle's files with progress.
import { DamagedBundle } from '../errors';
import { type Pages, parseKtx2 } from './ktx2';
import { type Atlas, type Manifest, parseManifest } from './manifest';
import type { Came, Source } from './source';
import { type Surfels, readSurfels } from './surfels';

export interface Bundle {
  info: Manifest;
  surfels: Surfels;
  pages: Pages | null;
  later: (() => Promise<Pages>) | null; // fetches the texels, if a first frame can be drawn without them
  cameras: string | null; // cameras.json
  photograph(name: string): Promise<string>; // its address for an image element
}

export const MOST_BESIDE = 1 << 26; // bytes of any file but surfels and texels

export type Progress = (done: number, total: number) => void;

const hex = (bytes: ArrayBuffer): string =>
  [...new Uint8Array(bytes)].map((byte) => byte.toString(16).padStart(2, '0')).join('');

export const loadManifest = async (source: Source): Promise<Manifest> => parseManifest(await source.manifest());

// Reads a file listed in bundle.json and checks its size and hash.
export async function readPart(source: Source, info: Manifest, name: string, came: Came): Promise<ArrayBuffer> {
  const entry = info.files.get(name);
  if (!entry) throw new DamagedBundle(`bundle.json does not list ${name}.`);
  const data = await source.read(name, entry.bytes, came);
  const subtle = (globalThis.crypto as Partial<Crypto> | undefined)?.subtle;
  if (subtle && hex(await subtle.digest('SHA-256', data)) !== entry.sha256) {
    throw new DamagedBundle(`${name} is altered: its SHA-256 is not the one in bundle.json.`);
  }
  return data;
}

// `admit` rejects scenes that are too large, before anything is decoded; `say` shows a line.
export async function loadBundle(
  source: Source,
  info: Manifest,
  progress: Progress,
  admit: (info: Manifest) => Promise<void>,
  say: (line: string) => void,
): Promise<Bundle> {
  const first = info.compact ? ['surfels.bin'] : ['surfels.ply', ...(info.atlas ? ['atlas.ktx2'] : [])];
  const total = first.reduce((sum, name) => sum + (info.files.get(name)?.bytes ?? 0), 0);
  let done = 0;
  const load = (name: string): Promise<ArrayBuffer> =>
    readPart(source, info, name, (bytes) => progress((done += bytes), total));
  const beside = (name: string): Promise<ArrayBuffer> => {
    const size = info.files.get(name)?.bytes ?? 0;
    if (size > MOST_BESIDE) throw new DamagedBundle(`${name} has ${size} bytes, at most ${MOST_BESIDE} are read.`);
    return readPart(source, info, name, () => undefined);
  };
  const views = async (): Promise<string | null> =>
    info.files.has('cameras.json') ? new TextDecoder().decode(await beside('cameras.json')) : null;
  const addresses = new Map<string, Promise<string>>();
  const photograph = (name: string): Promise<string> => {
    const made = async (): Promise<string> =>
      URL.createObjectURL(new Blob([await beside(name)], { type: 'image/jpeg' }));
    const address = addresses.get(name) ?? made();
    addresses.set(name, address);
    return address;
  };
  const [, cameras, table, atlas] = await Promise.all([admit(info), views(), ...first.map(load)]);
  if (!info.compact) {
    const pages = info.atlas ? parseKtx2(atlas, info.atlas) : null;
    return { info, surfels: readSurfels(table, info), pages, later: null, cameras, photograph };
  }
  const { decodeSurfels, decodeTexels } = await import('./compact/decoder');
  const surfels = await decodeSurfels(table, info, say);
  const texels = async (of: Atlas): Promise<Pages> => decodeTexels(await load('texels.bin'), of, surfels, say);
  return { info, surfels, pages: null, later: info.atlas ? () => texels(info.atlas!) : null, cameras, photograph };
}
