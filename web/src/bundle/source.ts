// Sources of a bundle's files: a folder on the server, or byte ranges of one file.
import { DamagedBundle, ViewerError } from '../errors';
import { type Entry, TAIL, entriesOf, partOf, placeOf } from './archive';

export type Came = (bytes: number) => void;
const nothing: Came = () => undefined;
const MANIFEST = 'bundle.json';
// Names of single-file bundles that the page may be asked to show.
export const BESIDE = /^[A-Za-z0-9][A-Za-z0-9._-]{0,99}\.bitymi$/;
const MOST_MANIFEST = 1 << 22; // bytes
const NOTES = 'notes.json';
const MOST_NOTES = 1 << 18; // bytes

export interface Source {
  read(name: string, size: number, came: Came): Promise<ArrayBuffer>;
  manifest(): Promise<string>;
  // Null if there is no notes.json; `stated`: whether view.json of a folder lists it.
  notes(stated: boolean): Promise<string | null>;
}

async function get(url: string, range?: string): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(url, range ? { headers: { Range: `bytes=${range}` } } : {});
  } catch {
    throw new ViewerError('The bundle cannot be reached', `${url} was not answered.`, 'Is the server still running?');
  }
  if (!response.ok) {
    const name = url.split('/').pop() ?? url;
    if (name === 'bundle.json' || name.endsWith('.bitymi')) {
      throw new ViewerError('There is no bundle', `${url} is not there.`, 'Export the scene again with bitymi view.');
    }
    throw new DamagedBundle(`${name} is missing, or is not what bundle.json says.`);
  }
  return response;
}

// Allocates only what has arrived.
async function bytesOf(response: Response, name: string, most: number, came: Came): Promise<Uint8Array<ArrayBuffer>> {
  const parts: Uint8Array[] = [];
  let at = 0;
  const body = response.body?.getReader();
  while (body) {
    const { done, value } = await body.read();
    if (done) break;
    if (at + value.length > most) throw new DamagedBundle(`${name} has more than ${most} bytes.`);
    parts.push(value);
    at += value.length;
    came(value.length);
  }
  const data = new Uint8Array(at);
  at = 0;
  for (const part of parts) {
    data.set(part, at);
    at += part.length;
  }
  return data;
}

export class Folder implements Source {
  constructor(private readonly url: string) {}

  async read(name: string, size: number, came: Came): Promise<ArrayBuffer> {
    const data = await bytesOf(await get(this.url + name), name, size, came);
    if (data.length !== size) throw new DamagedBundle(`${name} is truncated: ${data.length} of ${size} bytes.`);
    return data.buffer;
  }

  async manifest(): Promise<string> {
    return this.text(MANIFEST, MOST_MANIFEST);
  }

  async notes(stated: boolean): Promise<string | null> {
    return stated ? this.text(NOTES, MOST_NOTES) : null;
  }

  private async text(name: string, most: number): Promise<string> {
    return new TextDecoder().decode(await bytesOf(await get(this.url + name), name, most, nothing));
  }
}

const LARGEST = 2 ** 32; // bytes of a file without ZIP64

export class SingleFile implements Source {
  private constructor(
    private readonly url: string,
    private readonly entries: Map<string, Entry>,
    private readonly whole: Uint8Array<ArrayBuffer> | null,
  ) {}

  // Fetches the end of the file, with its directory; servers without ranges send all of it.
  static async open(url: string, progress: (done: number, total: number) => void): Promise<SingleFile> {
    const response = await get(url, `-${TAIL}`);
    const name = url.split('/').pop() ?? url;
    if (response.status !== 206) {
      const total = Number(response.headers.get('Content-Length')) || 0;
      let done = 0;
      const whole = await bytesOf(response, name, LARGEST, (bytes) => progress((done += bytes), total));
      const { begin, end } = placeOf(whole, whole.length);
      return new SingleFile(url, entriesOf(whole.subarray(begin, end), begin), whole);
    }
    const size = Number(/\/(\d+)$/.exec(response.headers.get('Content-Range') ?? '')?.[1]);
    if (!(size < LARGEST)) throw new DamagedBundle(`${name}: the server does not say how long it is.`);
    const tail = await bytesOf(response, name, TAIL, nothing);
    const { begin, end } = placeOf(tail, size);
    const from = begin - (size - tail.length); // in the tail, unless the directory is longer
    const directory =
      from >= 0
        ? tail.slice(from, from + end - begin)
        : await bytesOf(await get(url, `${begin}-${end - 1}`), name, end - begin, nothing);
    return new SingleFile(url, entriesOf(directory, begin), null);
  }

  private entry(name: string): Entry {
    const part = this.entries.get(name);
    if (!part) throw new DamagedBundle(`The bundle has no ${name}.`);
    if (!part.stored) throw new DamagedBundle(`${name} is not stored as it is.`);
    if (part.begin >= part.end) throw new DamagedBundle(`${name} lies beyond the end of the file.`);
    return part;
  }

  async read(name: string, size: number, came: Came): Promise<ArrayBuffer> {
    const { begin, end, size: has } = this.entry(name);
    if (has !== size) throw new DamagedBundle(`${name} has ${has} bytes, not ${size}.`);
    if (this.whole) {
      came(size);
      return partOf(this.whole.subarray(begin, end), name, size);
    }
    const response = await get(this.url, `${begin}-${end - 1}`);
    if (response.status !== 206) throw new DamagedBundle(`The server sends no ranges of ${this.url} any longer.`);
    return partOf(await bytesOf(response, name, end - begin, came), name, size);
  }

  async manifest(): Promise<string> {
    return this.text(MANIFEST, MOST_MANIFEST);
  }

  async notes(): Promise<string | null> {
    return this.entries.has(NOTES) ? this.text(NOTES, MOST_NOTES) : null;
  }

  private async text(name: string, most: number): Promise<string> {
    const { size } = this.entry(name);
    if (size > most) throw new DamagedBundle(`${name} has ${size} bytes, at most ${most} are read.`);
    return new TextDecoder().decode(await this.read(name, size, nothing));
  }
}
