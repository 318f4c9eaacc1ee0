import { readFileSync } from 'node:fs';
import { describe, expect, it } from 'vitest';
import { decodeBc7 } from '../src/bundle/bc7';

// Random blocks of every mode and their texels by Pillow, written by bc7_blocks.py.
const { blocks, texels } = JSON.parse(readFileSync(new URL('bc7.json', import.meta.url), 'utf8')) as Record<
  string,
  string
>;
const bytes = (text: string): Uint8Array => Uint8Array.from(Buffer.from(text, 'base64'));

describe('BC7', () => {
  it('is decoded bit by bit as by another decoder', () => {
    const given = bytes(blocks);
    const width = given.length / 4;
    expect(Buffer.compare(decodeBc7(given, width, 4), bytes(texels))).toBe(0);
  });
});
