import { describe, expect, it } from 'vitest';
import { loadPoster, loadPreview, isPoster } from '../src/bundle/poster';
import { parseManifest } from '../src/bundle/manifest';
import type { Source } from '../src/bundle/source';

// 8 x 6 pixels, written by Pillow: Image.save(..., 'WEBP', quality=60)
const PICTURE =
  'UklGRk4AAABXRUJQVlA4IEIAAAAQAgCdASoIAAYAAoBCJbACdLoAArrttTAAAP732ByCs6H23XwlH/5VpAC/5Sff/6OzD+d+//sN5xhOIGB+f4AAAAA=';
const bytes = (): Uint8Array<ArrayBuffer> => Uint8Array.from(atob(PICTURE), (c) => c.charCodeAt(0));
const changed = (at: number, value: number): ArrayBuffer => {
  const data = bytes();
  data[at] = value;
  return data.buffer;
};
const HASH = '0'.repeat(64);

async function pictureOf(
  load: typeof loadPoster,
  files: object,
  answer: () => Promise<ArrayBuffer>,
): Promise<Blob | null> {
  const info = parseManifest(
    JSON.stringify({
      format: 'bitymi-bundle',
      version: '2.3',
      surfels: { count: 2, view_color: 'sv', terms: 1 },
      atlas: null,
      render: { near: 0.1, weight_bound: 0.02, background: [0, 0, 0] },
      bounds: { min: [0, 0, 0], max: [2, 2, 2] },
      files,
    }),
  );
  return load({ read: answer } as unknown as Source, info);
}

const posterOf = (files: object, answer: () => Promise<ArrayBuffer>): Promise<Blob | null> =>
  pictureOf(loadPoster, files, answer);

describe('a preview', () => {
  it('is the first one of moderate size', async () => {
    const data = bytes();
    const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', data));
    const sha256 = [...digest].map((byte) => byte.toString(16).padStart(2, '0')).join('');
    const files = { 'preview.jpg': { bytes: 2 ** 30, sha256: HASH }, 'preview.png': { bytes: data.length, sha256 } };
    const found = await pictureOf(loadPreview, files, () => Promise.resolve(data.buffer));
    expect(found?.type).toBe('image/png');
  });
});

describe('a poster', () => {
  it('is a lossy WebP picture of moderate size', () => {
    expect(isPoster(bytes().buffer)).toBe(true);
    expect(isPoster(bytes().slice(0, -1).buffer)).toBe(false);
    expect(isPoster(new ArrayBuffer(0))).toBe(false);
    expect(isPoster(changed(15, 'X'.charCodeAt(0)))).toBe(false); // animated, or with colour profiles
    expect(isPoster(changed(27, 5))).toBe(false); // wider than 1,024
    expect(isPoster(changed(29, 0x40))).toBe(false); // with scaling
    expect(isPoster(changed(28, 0))).toBe(false);
    expect(isPoster(new TextEncoder().encode(`<svg xmlns="http://www.w3.org/2000/svg"></svg>`).buffer)).toBe(false);
  });
  it('is shown with the hash that is stated, and with no other', async () => {
    const data = bytes();
    const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', data));
    const sha256 = [...digest].map((byte) => byte.toString(16).padStart(2, '0')).join('');
    const answer = (): Promise<ArrayBuffer> => Promise.resolve(data.buffer);
    const found = await posterOf({ 'poster.webp': { bytes: data.length, sha256 } }, answer);
    expect(found?.type).toBe('image/webp');
    expect(await posterOf({ 'poster.webp': { bytes: data.length, sha256: HASH } }, answer)).toBeNull();
  });
  it('is done without', async () => {
    const never = (): Promise<ArrayBuffer> => Promise.reject(new Error('it was asked for'));
    expect(await posterOf({}, never)).toBeNull();
    expect(await posterOf({ 'poster.webp': { bytes: 86, sha256: HASH } }, never)).toBeNull();
    expect(await posterOf({ 'poster.webp': { bytes: 2 ** 30, sha256: HASH } }, never)).toBeNull();
  });
});
