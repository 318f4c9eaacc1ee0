// Parts of a bundle in one file: an uncompressed ZIP, written by bitymi_ns/bundle/single.py.
import { DamagedBundle } from '../errors';

export interface Entry {
  begin: number; // of the part, header included
  end: number;
  size: number; // without header
}

export const TAIL = 1 << 14; // bytes at the end that are fetched first for the directory
const END = { signature: 0x06054b50, bytes: 22 };
const CENTRAL = { signature: 0x02014b50, bytes: 46 };
const LOCAL = { signature: 0x04034b50, bytes: 30 };
const LONGEST = 1 << 22; // bytes of a directory
const NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$/;

const damaged = (what: string): DamagedBundle => new DamagedBundle(`The file is no bundle in one file: ${what}.`);

// Locates the directory of a file of `total` bytes from its last bytes.
export function placeOf(tail: Uint8Array<ArrayBuffer>, total: number): { begin: number; end: number; count: number } {
  const view = new DataView(tail.buffer, tail.byteOffset, tail.length);
  const at = tail.length - END.bytes;
  if (at < 0 || view.getUint32(at, true) !== END.signature) throw damaged('it is truncated, or something else');
  const [count, length, begin] = [
    view.getUint16(at + 10, true),
    view.getUint32(at + 12, true),
    view.getUint32(at + 16, true),
  ];
  const end = begin + length;
  if (length > LONGEST || end !== total - END.bytes) throw damaged('its directory is not where it is said to be');
  return { begin, end, count };
}

// Reads the parts by name from the directory, which begins at byte `place` of the file.
export function entriesOf(directory: Uint8Array<ArrayBuffer>, place: number, count: number): Map<string, Entry> {
  const view = new DataView(directory.buffer, directory.byteOffset, directory.length);
  const found: [string, number, number][] = [];
  let at = 0;
  for (let k = 0; k < count; k++) {
    if (at + CENTRAL.bytes > directory.length || view.getUint32(at, true) !== CENTRAL.signature) {
      throw damaged('its directory is damaged');
    }
    const [method, packed, size] = [
      view.getUint16(at + 10, true),
      view.getUint32(at + 20, true),
      view.getUint32(at + 24, true),
    ];
    const lengths = [28, 30, 32].map((field) => view.getUint16(at + field, true));
    const name = new TextDecoder().decode(directory.subarray(at + CENTRAL.bytes, at + CENTRAL.bytes + lengths[0]));
    if (method !== 0 || packed !== size) throw damaged(`${name} is not stored as it is`);
    if (NAME.test(name)) found.push([name, view.getUint32(at + 42, true), size]);
    at += CENTRAL.bytes + lengths[0] + lengths[1] + lengths[2];
  }
  found.sort((a, b) => a[1] - b[1]);
  const entries = new Map(
    found.map(([name, begin, size], k) => {
      const end = k + 1 < found.length ? found[k + 1][1] : place;
      if (begin + LOCAL.bytes + name.length + size > end) throw damaged(`${name} lies over what follows`);
      return [name, { begin, end, size }];
    }),
  );
  if (entries.size !== found.length) throw damaged('two parts have one name');
  return entries;
}

// Strips a part's header.
export function partOf(stored: Uint8Array<ArrayBuffer>, name: string, size: number): ArrayBuffer {
  const view = new DataView(stored.buffer, stored.byteOffset, stored.length);
  if (stored.length < LOCAL.bytes || view.getUint32(0, true) !== LOCAL.signature) throw damaged(`${name} is not there`);
  const begin = LOCAL.bytes + view.getUint16(26, true) + view.getUint16(28, true);
  if (begin + size > stored.length) throw damaged(`${name} is truncated`);
  return stored.slice(begin, begin + size).buffer;
}
