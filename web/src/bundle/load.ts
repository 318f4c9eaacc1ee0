// Fetches a bundle's files, with progress, and checks their sizes and hashes.
import { DamagedBundle, ViewerError } from '../errors';
import { type Pages, parseKtx2 } from './ktx2';
import { type Atlas, type Manifest, parseManifest } from './manifest';
import { type Surfels, readSurfels } from './surfels';

export interface Bundle {
  info: Manifest;
  surfels: Surfels;
  pages: Pages | null;
  later: (() => Promise<Pages>) | null; // fetches the texels, where a first picture can be drawn without them
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

// No memory is taken for what has not come.
async function bytesOf(url: string, size: number, came: (bytes: number) => void): Promise<ArrayBuffer> {
  const response = await get(url);
  const name = url.split('/').pop() ?? url;
  const parts: Uint8Array[] = [];
  let at = 0;
  const body = response.body?.getReader();
  while (body) {
    const { done, value } = await body.read();
    if (done) break;
    if (at + value.length > size) throw new DamagedBundle(`${name} is longer than the ${size} bytes of bundle.json.`);
    parts.push(value);
    at += value.length;
    came(value.length);
  }
  if (at !== size) throw new DamagedBundle(`${name} is truncated: ${at} of ${size} bytes.`);
  const data = new Uint8Array(size);
  at = 0;
  for (const part of parts) {
    data.set(part, at);
    at += part.length;
  }
  return data.buffer;
}

const hex = (bytes: ArrayBuffer): string =>
  [...new Uint8Array(bytes)].map((byte) => byte.toString(16).padStart(2, '0')).join('');

export async function loadBundle(folder: string, progress: Progress): Promise<Bundle> {
  const info = parseManifest(await (await get(`${folder}bundle.json`)).text());
  const first = info.compact ? ['surfels.bin'] : ['surfels.ply', ...(info.atlas ? ['atlas.ktx2'] : [])];
  const total = first.reduce((sum, name) => sum + (info.files.get(name)?.bytes ?? 0), 0);
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
  const views = async (): Promise<string | null> =>
    info.files.has('cameras.json') ? (await get(`${folder}cameras.json`)).text() : null;
  const [cameras, table, atlas] = await Promise.all([views(), ...first.map(load)]);
  if (!info.compact) {
    const pages = info.atlas ? await parseKtx2(atlas, info.atlas) : null;
    return { info, surfels: readSurfels(table, info), pages, later: null, cameras };
  }
  const { Decoder } = await import('./compact/decoder');
  const decoder = new Decoder();
  const surfels = await decoder.surfels(table, info);
  if (!info.atlas) decoder.end();
  const texels = async (of: Atlas): Promise<Pages> => decoder.texels(await load('texels.bin'), of, surfels);
  return { info, surfels, pages: null, later: info.atlas ? () => texels(info.atlas!) : null, cameras };
}
