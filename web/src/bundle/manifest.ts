// The part of bundle.json that the viewer needs; bitymi_ns/bundle/manifest.py has the whole schema.
import { DamagedBundle, ViewerError } from '../errors';
import type { Column } from './compact/columns';
import { EARLIER, EXTENT, FORMAT, REDUCED_WIDTH, NEWEST_MAJOR, RANGES } from './tables';

export type ViewKind = keyof typeof REDUCED_WIDTH;
export type AtlasFormat = 'bc7' | 'uint8' | 'fp16';
export type Vec3 = [number, number, number];

type Json = Record<string, unknown>;

// Reads an object of bundle.json; the ranges of its numbers are those of `name` in RANGES.
class Reader {
  constructor(
    private readonly value: Json,
    private readonly path = '',
    private readonly name = '',
  ) {}

  private refuse(key: string, what: string): never {
    throw new DamagedBundle(`bundle.json: ${this.path}${key} must be ${what}.`);
  }
  has(key: string): boolean {
    return this.value[key] !== undefined && this.value[key] !== null;
  }
  part(key: string): Reader {
    const entry = this.value[key];
    if (typeof entry !== 'object' || entry === null || Array.isArray(entry)) this.refuse(key, 'an object');
    return new Reader(entry as Json, `${this.path}${key}.`, key);
  }
  number(key: string): number {
    const [entry, [low, high]] = [this.value[key], RANGES[`${this.name}.${key}`]];
    if (typeof entry !== 'number' || !(entry >= low && entry <= high)) {
      this.refuse(key, `a number from ${low} to ${high}`);
    }
    return entry;
  }
  whole(key: string): number {
    const entry = this.number(key);
    if (!Number.isInteger(entry)) this.refuse(key, 'a whole number');
    return entry;
  }
  choice<T extends string>(key: string, choices: readonly T[]): T {
    const entry = this.value[key];
    if (!choices.includes(entry as T)) this.refuse(key, `one of ${choices.join(', ')}`);
    return entry as T;
  }
  point(key: string): Vec3 {
    const [entry, [low, high]] = [this.value[key], RANGES[`${this.name}.${key}`]];
    const good = (x: unknown): boolean => typeof x === 'number' && x >= low && x <= high;
    if (!Array.isArray(entry) || entry.length !== 3 || !entry.every(good)) this.refuse(key, 'three numbers');
    return entry as Vec3;
  }
  list(key: string, most: number): unknown[] {
    const entry = this.value[key];
    if (!Array.isArray(entry) || entry.length > most) this.refuse(key, `a list of at most ${most}`);
    return entry as unknown[];
  }
  parts(key: string, most: number): Reader[] {
    return this.list(key, most).map((part, k) => {
      if (typeof part !== 'object' || part === null) this.refuse(`${key}.${k}`, 'an object');
      return new Reader(part as Json, `${this.path}${key}.${k}.`, key);
    });
  }
  wholes(key: string, most: number): number[] {
    const [entry, [low, high]] = [this.list(key, most), RANGES[`${this.name}.${key}`]];
    const good = (x: unknown): boolean => Number.isInteger(x) && (x as number) >= low && (x as number) <= high;
    if (!entry.every(good)) this.refuse(key, `whole numbers from ${low} to ${high}`);
    return entry as number[];
  }
  entries(most: number): [string, Reader][] {
    const keys = Object.keys(this.value);
    if (keys.length > most) throw new DamagedBundle(`bundle.json: ${this.path} has more than ${most} keys.`);
    return keys.map((key) => [key, new Reader(this.part(key).value, `${this.path}${key}.`, this.name)]);
  }
  text(key: string, pattern: RegExp): string {
    const entry = this.value[key];
    if (typeof entry !== 'string' || !pattern.test(entry)) this.refuse(key, `a text like ${pattern.source}`);
    return entry;
  }
}

const MOST_COLUMNS = 64;
const MOST_NUMBERS = 16; // per row of a column
const MOST_POINTS = 4096;
const MOST_FILES = 1 << 14;
const RATES = [1e-12, 1e12]; // pixels per unit of length

function columns(r: Reader): Column[] {
  return r.parts('columns', MOST_COLUMNS).map((column) => ({
    name: column.text('name', /^[a-z0-9_]{1,20}$/),
    step: column.has('step') ? column.number('step') : null,
    bytes: column.wholes('bytes', MOST_NUMBERS),
  }));
}

// Describes surfels.bin; the frame is that of the positions.
function compact(r: Reader) {
  const frame = r.part('frame');
  const [center, scale, low] = [frame.point('center'), frame.number('scale'), frame.point('low')];
  return { frame: { center, scale, low }, columns: columns(r) };
}
export type CompactSurfels = ReturnType<typeof compact>;

// Describes texels.bin.
function texels(r: Reader, surfelBytes: number) {
  return {
    texels: r.whole('texels'),
    step: r.number('step'),
    pageWidth: r.whole('page_width'),
    pageRows: r.whole('page_rows'),
    columns: columns(r),
    surfelBytes, // of surfels.bin
  };
}
export type CodedTexels = ReturnType<typeof texels>;

function atlas(r: Reader, isCompact: boolean, surfelBytes: number) {
  const format: AtlasFormat | 'dct' = r.choice('format', isCompact ? ['dct'] : ['bc7', 'uint8', 'fp16']);
  return {
    format,
    width: r.whole('width'),
    height: r.whole('height'),
    layers: r.whole('layers'),
    extent: r.has('extent') ? r.number('extent') : EXTENT,
    offset: r.number('offset'),
    scale: r.number('scale'),
    alphaScale: r.has('alpha_scale') ? r.number('alpha_scale') : 0, // 0: opaque scene
    coded: isCompact ? texels(r, surfelBytes) : null, // format dct
  };
}
export type Atlas = ReturnType<typeof atlas>;

// Points of the scene, with the pixels per unit of length of their photographs.
function points(r: Reader): Float32Array {
  const text = r.text('photographed', /^[A-Za-z0-9+/]*={0,2}$/);
  const refuse = (): never => {
    throw new DamagedBundle('bundle.json: render.photographed must hold places and rates in range.');
  };
  let bytes: Uint8Array;
  try {
    bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  } catch {
    return refuse();
  }
  if (bytes.length % 16 || bytes.length > 16 * MOST_POINTS) refuse();
  const view = new DataView(bytes.buffer);
  const rows = Float32Array.from({ length: bytes.length / 4 }, (_, i) => view.getFloat32(4 * i, true));
  const good = (x: number, i: number): boolean => (i % 4 < 3 ? Math.abs(x) <= 1e9 : x >= RATES[0] && x <= RATES[1]);
  return rows.every(good) ? rows : refuse();
}

export function parseManifest(text: string) {
  let json: unknown;
  try {
    json = JSON.parse(text);
  } catch {
    throw new DamagedBundle('bundle.json cannot be read as JSON.');
  }
  if (typeof json !== 'object' || json === null || (json as Json).format !== FORMAT) {
    throw new ViewerError('This is not a bundle', `bundle.json has not the format ${FORMAT}.`, 'Open another folder.');
  }
  const root = new Reader(json as Json);
  const version = root.text('version', /^[0-9]{1,6}\.[0-9]{1,6}$/);
  const major = Number(version.split('.')[0]);
  if (major > NEWEST_MAJOR) {
    throw new ViewerError(
      'This bundle is newer than the viewer',
      `It has version ${version}; this viewer reads up to ${NEWEST_MAJOR}.x.`,
      'Update bitymi-ns, and export the page again if this is an exported one.',
    );
  }
  const surfels = root.part('surfels');
  const render = root.part('render');
  const bounds = root.part('bounds');
  const world = root.has('world') ? root.part('world') : null;
  const files = new Map(
    root
      .part('files')
      .entries(MOST_FILES)
      .map(([name, r]) => [name, { bytes: r.whole('bytes'), sha256: r.text('sha256', /^[0-9a-f]{64}$/) }]),
  );
  const isCompact = files.has('surfels.bin');
  if (major < NEWEST_MAJOR && !EARLIER[version]?.includes(isCompact ? 'surfels.bin' : 'surfels.ply')) {
    throw new ViewerError(
      'This bundle is of a version that is read no longer',
      `It has version ${version}.`,
      'Export it again.',
    );
  }
  const texture = root.has('atlas') ? atlas(root.part('atlas'), isCompact, files.get('surfels.bin')?.bytes ?? 0) : null;
  if (render.has('prefilter')) render.choice('prefilter', ['low_pass']); // others are drawn no longer
  return {
    version,
    count: surfels.whole('count'),
    viewColor: surfels.choice('view_color', Object.keys(REDUCED_WIDTH) as ViewKind[]),
    terms: surfels.has('terms') || isCompact ? surfels.whole('terms') : null,
    compact: isCompact ? compact(surfels) : null, // if in surfels.bin
    atlas: texture,
    near: render.number('near'),
    weightBound: render.number('weight_bound'),
    photographed: render.has('photographed') ? points(render) : null, // rows x, y, z, pixels per unit of length
    background: render.point('background'),
    bounds: { min: bounds.point('min'), max: bounds.point('max') },
    up: world?.has('up') ? world.point('up') : null,
    metres: world?.has('metres_per_unit') ? world.number('metres_per_unit') : null, // per unit of the scene
    files,
  };
}
export type Manifest = ReturnType<typeof parseManifest>;
