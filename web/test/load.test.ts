// Every fetched file is bounded and compared with bundle.json.
import { createHash } from 'node:crypto';
import { afterEach, describe, expect, it, vi } from 'vitest';
import { loadBundle } from '../src/bundle/load';
import { type Manifest, parseManifest } from '../src/bundle/manifest';
import { Folder, type Source } from '../src/bundle/source';
import { DamagedBundle, ViewerError } from '../src/errors';
import { BUNDLES, bytes } from './compact_bundles';

const info = parseManifest(new TextDecoder().decode(bytes(BUNDLES.plain.files['bundle.json'])));
const CAMERAS = '{"cameras": []}';
const encode = (text: string): Uint8Array => new TextEncoder().encode(text);
const listed = (text: string, size = text.length): { bytes: number; sha256: string } => ({
  bytes: size,
  sha256: createHash('sha256').update(text).digest('hex'),
});

const said: string[] = [];

class Sent implements Source {
  constructor(private readonly files: Record<string, Uint8Array>) {}
  read(name: string): Promise<ArrayBuffer> {
    return Promise.resolve(Uint8Array.from(this.files[name]).buffer);
  }
  manifest(): Promise<string> {
    return Promise.reject(new Error('it is not asked for'));
  }
  notes(): Promise<null> {
    return Promise.resolve(null);
  }
}

// Without surfels, which have no decoder here; the files after them are requested at the same time.
const open = (files: Record<string, Uint8Array>, about: Manifest, admit = (): Promise<void> => Promise.resolve()) =>
  loadBundle(
    new Sent({ 'surfels.bin': new Uint8Array(), ...files }),
    about,
    () => undefined,
    admit,
    (line) => said.push(line),
  );
const withFile = (name: string, entry: { bytes: number; sha256: string }): Manifest => ({
  ...info,
  files: new Map([['surfels.bin', listed('')], ...(name ? [[name, entry] as const] : [])]),
});

describe('cameras.json', () => {
  it('that is altered is refused', async () => {
    const about = withFile('cameras.json', listed(CAMERAS));
    await expect(open({ 'cameras.json': encode('{"cameras": {}}') }, about)).rejects.toThrowError(
      /cameras.json is altered/,
    );
  });
  it('that is too large is not asked for', async () => {
    const about = withFile('cameras.json', listed(CAMERAS, 2 ** 30));
    await expect(open({ 'cameras.json': encode(CAMERAS) }, about)).rejects.toThrowError(/at most 67108864/);
  });
});

describe('a scene', () => {
  it('that is not admitted is not decoded', async () => {
    const no = new ViewerError('too large', '', '');
    await expect(open({}, withFile('', listed('')), () => Promise.reject(no))).rejects.toBe(no);
  });
});

class Slow {
  static made: Slow[] = [];
  ended = false;
  onmessage: (event: unknown) => void = () => undefined;
  onerror: (event: unknown) => void = () => undefined;
  constructor() {
    Slow.made.push(this);
  }
  postMessage(): void {
    return undefined;
  }
  terminate(): void {
    this.ended = true;
  }
}

describe('a decoder', () => {
  afterEach(() => {
    vi.useRealTimers();
    vi.unstubAllGlobals();
    Slow.made = [];
    said.length = 0;
  });
  const worker = async (): Promise<Slow> => vi.waitUntil(() => Slow.made.at(-1));

  it('that takes minutes is waited for, says so, and is ended', async () => {
    vi.stubGlobal('Worker', Slow);
    vi.useFakeTimers({ toFake: ['setTimeout', 'clearTimeout'] });
    const loading = open({}, withFile('', listed('')));
    const slow = await worker();
    vi.advanceTimersByTime(19_000);
    expect(said).toEqual([]);
    vi.advanceTimersByTime(200_000);
    expect(said).toEqual(['surfels.bin is still being decoded.']);
    expect(slow.ended).toBe(false);
    slow.onmessage({ data: { made: {} } });
    await loading;
    expect(slow.ended).toBe(true);
  });
  it('that fails is ended', async () => {
    vi.stubGlobal('Worker', Slow);
    for (const fail of [
      (slow: Slow): void => slow.onerror({ message: 'no script' }),
      (slow: Slow): void => slow.onmessage({ data: { made: null, title: 'damaged', detail: '', advice: '' } }),
    ]) {
      Slow.made = [];
      const loading = open({}, withFile('', listed('')));
      fail(await worker());
      await expect(loading).rejects.toThrow();
      expect(Slow.made.every((each) => each.ended)).toBe(true);
    }
  });
  it('of surfels is ended where the texels do not arrive', async () => {
    vi.stubGlobal('Worker', Slow);
    const loading = open({}, { ...withFile('', listed('')), atlas: {} as Manifest['atlas'] });
    (await worker()).onmessage({ data: { made: {} } });
    await expect((await loading).later!()).rejects.toThrowError(/does not list texels.bin/);
    expect(Slow.made.map((each) => each.ended)).toEqual([true]);
  });
});

describe('a photograph', () => {
  const ply = [
    'ply\nformat binary_little_endian 1.0\nelement vertex 0',
    ...['x', 'y', 'z', 'rot_0', 'rot_1', 'rot_2', 'rot_3', 'scale_0', 'scale_1', 'opacity', 'beta'],
    ...['view_base_0', 'view_base_1', 'view_base_2'],
  ].join('\nproperty float ');
  const terms = [0, 1, 2, 3, 4, 5].map((k) => `property float term_${k}`).join('\n');
  const tiles = ['view_terms', 'tile_x', 'tile_y', 'tile_layer', 'tile_ru', 'tile_rv'].join('\nproperty int ');
  const table = `${ply}\nproperty int ${tiles}\nelement view_term 0\n${terms}\nend_header\n`;
  const about: Manifest = {
    ...info,
    compact: null,
    atlas: null,
    count: 0,
    files: new Map([
      ['surfels.ply', listed(table)],
      ['a.jpg', listed('a picture')],
    ]),
  };
  const opened = (picture: string): ReturnType<typeof loadBundle> =>
    open({ 'surfels.ply': encode(table), 'a.jpg': encode(picture) }, about);

  it('is shown as it is listed, and fetched once', async () => {
    const bundle = await opened('a picture');
    const [first, second] = [bundle.photograph('a.jpg'), bundle.photograph('a.jpg')];
    expect(first).toBe(second);
    await expect(first).resolves.toMatch(/^blob:/);
  });
  it('that is altered, or not listed, is refused', async () => {
    const bundle = await opened('b picture');
    await expect(bundle.photograph('a.jpg')).rejects.toThrowError(/a.jpg is altered/);
    await expect(bundle.photograph('b.jpg')).rejects.toThrowError(/does not list b.jpg/);
  });
});

describe('bundle.json', () => {
  afterEach(() => {
    vi.unstubAllGlobals();
  });
  it('without an end is not read to its end', async () => {
    let sent = 0;
    const body = new ReadableStream({
      pull: (out) => {
        sent += 1 << 20;
        out.enqueue(new Uint8Array(1 << 20));
      },
    });
    vi.stubGlobal('fetch', () => Promise.resolve(new Response(body)));
    await expect(new Folder('x/').manifest()).rejects.toThrowError(DamagedBundle);
    expect(sent).toBeLessThan(1 << 23);
  });
});
