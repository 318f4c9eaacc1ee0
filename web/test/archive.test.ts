import { readFileSync } from 'node:fs';
import { describe, expect, it } from 'vitest';
import { type Entry, entriesOf, partOf, placeOf } from '../src/bundle/archive';
import { DamagedBundle } from '../src/errors';

// parts as stored by bitymi_ns.bundle.single, written by archive_parts.py
const golden = JSON.parse(readFileSync(new URL('./archive.json', import.meta.url), 'utf8')) as {
  file: string;
  parts: Record<string, string>;
};
const file = Uint8Array.from(atob(golden.file), (c) => c.charCodeAt(0));

function partsOf(bytes: Uint8Array<ArrayBuffer>): Map<string, Entry> {
  const { begin, end, count } = placeOf(bytes, bytes.length);
  return entriesOf(bytes.subarray(begin, end), begin, count);
}

describe('a bundle in one file', () => {
  it('has its parts where its directory says', () => {
    const found = partsOf(file);
    expect([...found.keys()].sort()).toEqual(Object.keys(golden.parts).sort());
    for (const [name, { begin, end, size }] of found) {
      expect(new TextDecoder().decode(partOf(file.subarray(begin, end), name, size))).toBe(golden.parts[name]);
    }
  });
  it('is found by its end alone', () => {
    const tail = file.slice(-200);
    expect(placeOf(tail, file.length)).toEqual(placeOf(file, file.length));
  });
  it('is refused where it is truncated', () => {
    for (const length of [0, 10, 100, file.length - 1]) {
      expect(() => partsOf(file.slice(0, length))).toThrow(DamagedBundle);
    }
  });
  it('is refused where two parts have one name', () => {
    const changed = file.slice();
    const at = new TextDecoder('latin1').decode(file).lastIndexOf('surfels.bin');
    changed.set(new TextEncoder().encode('bundle.json'), at);
    expect(() => partsOf(changed)).toThrow(/two parts have one name/);
  });
  it('is refused, or read within its bounds, whatever byte is changed', () => {
    for (let at = 0; at < file.length; at++) {
      const changed = file.slice();
      changed[at] ^= 0xff;
      try {
        for (const [name, { begin, end, size }] of partsOf(changed)) {
          expect(begin).toBeLessThan(end);
          expect(end).toBeLessThanOrEqual(changed.length);
          expect(partOf(changed.subarray(begin, end), name, size).byteLength).toBe(size);
        }
      } catch (error) {
        expect(error).toBeInstanceOf(DamagedBundle);
      }
    }
  });
});
