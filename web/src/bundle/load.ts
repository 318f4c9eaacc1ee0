// Fetches a bundle's files, with progress, and checks their sizes and hashes.
import { DamagedBundle, ViewerError } from '../errors';
import { type Pages, parseKtx2 } from './ktx2';
import { type Manifest, parseManifest } from './manifest';
import { type Surfels, readSurfels } from './surfels';

export interface Bundle {
  info: Manifest;
  surfels: Surfels;
  pages: Pages | null;
  cameras: string | null; // cameras.json
}

export type Progress = (done: number, total: number) => void;

async function get(url: string): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(url);
  } catch {
    throw new ViewerError('The bundle cannot be reached', `${url} was not answered.`, 'Is the server still running?');
  }
  if (!response.ok) {
    const name = url.split('/').pop() ?? url;
    if (name === 'bundle.json') {
      throw new ViewerError('There is no bundle', `${url} is not there.`, 'Export the scene again with bitymi view.');
    }
    throw new DamagedBundle(`${name} is missing.`);
  }
  return response;
}

async function bytesOf(url: string, size: number, came: (bytes: number) => void): Promise<ArrayBuffer> {
  const response = await get(url);
  const data = new Uint8Array(size);
  const name = url.split('/').pop() ?? url;
  let at = 0;
  const body = response.body?.getReader();
  while (body) {
    const { done, value } = await body.read();
    if (done) break;
    if (at + value.length > size) throw new DamagedBundle(`${name} is longer than the ${size} bytes of bundle.json.`);
    data.set(value, at);
    at += value.length;
    came(value.length);
  }
  if (at !== size) throw new DamagedBundle(`${name} is truncated: ${at} of ${size} bytes.`);
  return data.buffer;
}

const hex = (bytes: ArrayBuffer): string =>
  [...new Uint8Array(bytes)].map((byte) => byte.toString(16).padStart(2, '0')).join('');

export async function loadBundle(folder: string, progress: Progress): Promise<Bundle> {
  const info = parseManifest(await (await get(`${folder}bundle.json`)).text());
  const wanted = ['surfels.ply', ...(info.atlas ? ['atlas.ktx2'] : [])];
  const total = wanted.reduce((sum, name) => sum + (info.files.get(name)?.bytes ?? 0), 0);
  let done = 0;
  const load = async (name: string): Promise<ArrayBuffer> => {
    const entry = info.files.get(name);
    if (!entry) throw new DamagedBundle(`bundle.json does not list ${name}.`);
    const data = await bytesOf(`${folder}${name}`, entry.bytes, (bytes) => progress((done += bytes), total));
    const subtle = (globalThis.crypto as Partial<Crypto> | undefined)?.subtle;
    if (subtle && hex(await subtle.digest('SHA-256', data)) !== entry.sha256) {
      throw new DamagedBundle(`${name} is altered: its SHA-256 is not the one in bundle.json.`);
    }
    return data;
  };
  const [table, atlas] = await Promise.all(wanted.map(load));
  const surfels = readSurfels(table, info);
  const pages = info.atlas ? await parseKtx2(atlas, info.atlas) : null;
  const cameras = info.files.has('cameras.json') ? await (await get(`${folder}cameras.json`)).text() : null;
  return { info, surfels, pages, cameras };
}
