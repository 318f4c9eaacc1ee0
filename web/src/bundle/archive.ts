// Parts of a bundle in one file, an uncompressed ZIP, as bitymi_ns/bundle/parts.py reads them. Hashes in bundle.json
// decide whether they are whole.
import { DamagedBundle } from '../errors';

export interface Entry {
  begin: number; // of the part, header included
  end: number; // behind the part, whatever the length of its header
  size: number; // without header
  stored: boolean; // as it is, not deflated
}

export const TAIL = 1 << 14; // bytes at the end that are fetched first for the directory
const END = { signature: 0x06054b50, bytes: 22 };
const CENTRAL = { signature: 0x02014b50, bytes: 46 };
const LOCAL = { signature: 0x04034b50, bytes: 30 };
const LONGEST = 1 << 22; // bytes of a directory
const SLACK = 64; // most bytes of a part's header beyond LOCAL and its name
const NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$/;

const damaged = (what: string): DamagedBundle => new DamagedBundle(`The file is no bundle in one file: ${what}.`);

// Locates the directory of a file of `total` bytes.
export function placeOf(tail: Uint8Array<ArrayBuffer>, total: number): { begin: number; end: number } {
  const view = new DataView(tail.buffer, tail.byteOffset, tail.length);
  const at = tail.length - END.bytes;
  if (at < 0 || view.getUint32(at, true) !== END.signature || view.getUint16(at + 20, true)) {
    throw damaged('it is truncated, or something else');
  }
  const [length, begin] = [view.getUint32(at + 12, true), view.getUint32(at + 16, true)];
  const end = begin + length;
  if (length > LONGEST || end !== total - END.bytes) throw damaged('its directory is not where it is said to be');
  return { begin, end };
}

// Reads the directory, which begins at byte `place` of the file.
export function entriesOf(directory: Uint8Array<ArrayBuffer>, place: number): Map<string, Entry> {
  const view = new DataView(directory.buffer, directory.byteOffset, directory.length);
  const entries = new Map<string, Entry>();
  for (let at = 0; at < directory.length;) {
    if (at + CENTRAL.bytes > directory.length || view.getUint32(at, true) !== CENTRAL.signature) {
      throw damaged('its directory is damaged');
    }
    const [packed, size, begin] = [20, 24, 42].map((field) => view.getUint32(at + field, true));
    const lengths = [28, 30, 32].map((field) => view.getUint16(at + field, true));
    const stored = view.getUint16(at + 10, true) === 0 && packed === size;
    at += CENTRAL.bytes;
    const name = new TextDecoder('latin1').decode(directory.subarray(at, at + lengths[0]));
    at += lengths[0] + lengths[1] + lengths[2];
    if (at > directory.length) throw damaged('its directory is damaged');
    if (entries.has(name)) throw damaged('two parts have one name');
    const end = Math.min(place, begin + LOCAL.bytes + name.length + SLACK + size);
    if (NAME.test(name)) entries.set(name, { begin, end, size, stored });
  }
  return entries;
}

// Strips a part's header.
export function partOf(stored: Uint8Array<ArrayBuffer>, name: string, size: number): ArrayBuffer {
  const view = new DataView(stored.buffer, stored.byteOffset, stored.length);
  const there = stored.length >= LOCAL.bytes && view.getUint32(0, true) === LOCAL.signature;
  const begin = there ? LOCAL.bytes + view.getUint16(26, true) + view.getUint16(28, true) : 0;
  if (!there || begin > LOCAL.bytes + name.length + SLACK || begin + size > stored.length) {
    throw damaged(`${name} does not lie where its directory says`);
  }
  return stored.slice(begin, begin + size).buffer;
}
