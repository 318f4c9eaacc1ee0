import { readFileSync } from 'node:fs';
import { afterEach, describe, expect, it, vi } from 'vitest';
import { type Entry, entriesOf, partOf, placeOf } from '../src/bundle/archive';
import { SingleFile } from '../src/bundle/source';
import { DamagedBundle } from '../src/errors';

// parts as stored by bitymi_ns.bundle.single, written by archive_parts.py
const golden = JSON.parse(readFileSync(new URL('./archive.json', import.meta.url), 'utf8')) as {
  file: string;
  parts: Record<string, string>;
  damage: Record<string, { file: string; parts: Record<string, string | null> | null }>;
};
const decode = (text: string): Uint8Array<ArrayBuffer> => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const file = decode(golden.file);

function partsOf(bytes: Uint8Array<ArrayBuffer>): Map<string, Entry> {
  const { begin, end } = placeOf(bytes, bytes.length);
  return entriesOf(bytes.subarray(begin, end), begin);
}

afterEach(() => vi.unstubAllGlobals());

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
  // as tests/bundle/test_parts.py reads them, on servers with ranges and without
  it.each(Object.entries(golden.damage))('with damage is read as the package reads it: %s', async (_, row) => {
    const bytes = decode(row.file);
    for (const ranges of [true, false]) {
      vi.stubGlobal('fetch', (_url: string, { headers }: { headers: { Range?: string } }) => {
        const [first, last] = (headers.Range?.slice(6) ?? '').split('-').map(Number);
        const begin = headers.Range?.startsWith('bytes=-') ? Math.max(0, bytes.length - last) : first;
        const part = bytes.slice(begin, headers.Range?.startsWith('bytes=-') ? undefined : last + 1);
        const range = { 'Content-Range': `bytes ${begin}-${begin + part.length - 1}/${bytes.length}` };
        return Promise.resolve(ranges ? new Response(part, { status: 206, headers: range }) : new Response(bytes));
      });
      const opened = SingleFile.open('https://example.org/b.bitymi', () => undefined);
      if (row.parts === null) {
        await expect(opened).rejects.toBeInstanceOf(DamagedBundle);
        continue;
      }
      const source = await opened;
      for (const [name, text] of Object.entries(row.parts)) {
        const read = source.read(name, text?.length ?? golden.parts[name].length, () => undefined);
        if (text === null) await expect(read).rejects.toBeInstanceOf(DamagedBundle);
        else expect(new TextDecoder().decode(await read)).toBe(text);
      }
    }
  });
  it('is refused, or read within its bounds, whatever byte is changed', () => {
    for (let at = 0; at < file.length; at++) {
      const changed = file.slice();
      changed[at] ^= 0xff;
      try {
        for (const [name, { begin, end, size }] of partsOf(changed)) {
          expect(end).toBeLessThanOrEqual(changed.length);
          expect(partOf(changed.subarray(begin, end), name, size).byteLength).toBe(size);
        }
      } catch (error) {
        expect(error).toBeInstanceOf(DamagedBundle);
      }
    }
  });
});
