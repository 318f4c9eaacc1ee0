// bundle.json: what the viewer needs of it. bitymi_ns/bundle/manifest.py is the whole description.
import { DamagedBundle, ViewerError } from '../errors';

export const FORMAT = 'bitymi-bundle';
export const NEWEST_MAJOR = 2;

export type ViewKind = 'sv' | 'sh' | 'sb' | 'sg';
export type AtlasFormat = 'bc7' | 'uint8' | 'fp16';
export type Vec3 = [number, number, number];

export interface Atlas {
  format: AtlasFormat;
  width: number;
  height: number;
  layers: number;
  extent: number;
  offset: number;
  scale: number;
}

export interface Manifest {
  version: string;
  count: number;
  viewColor: ViewKind;
  terms: number | null;
  atlas: Atlas | null;
  near: number;
  weightBound: number;
  throughPixel: boolean;
  background: Vec3;
  bounds: { min: Vec3; max: Vec3 };
  up: Vec3 | null;
  files: Map<string, { bytes: number; sha256: string }>;
}

type Json = Record<string, unknown>;

class Reader {
  constructor(
    private readonly value: Json,
    private readonly path: string,
  ) {}

  private refuse(key: string, what: string): never {
    throw new DamagedBundle(`bundle.json: ${this.path}${key} must be ${what}.`);
  }
  has(key: string): boolean {
    return this.value[key] !== undefined && this.value[key] !== null;
  }
  part(key: string): Reader {
    const found = this.value[key];
    if (typeof found !== 'object' || found === null || Array.isArray(found)) this.refuse(key, 'an object');
    return new Reader(found as Json, `${this.path}${key}.`);
  }
  number(key: string, low: number, high: number): number {
    const found = this.value[key];
    if (typeof found !== 'number' || !(found >= low && found <= high)) {
      this.refuse(key, `a number from ${low} to ${high}`);
    }
    return found;
  }
  whole(key: string, low: number, high: number): number {
    const found = this.number(key, low, high);
    if (!Number.isInteger(found)) this.refuse(key, 'a whole number');
    return found;
  }
  choice<T extends string>(key: string, choices: readonly T[]): T {
    const found = this.value[key];
    if (!choices.includes(found as T)) this.refuse(key, `one of ${choices.join(', ')}`);
    return found as T;
  }
  point(key: string, limit: number): Vec3 {
    const found = this.value[key];
    const good = (x: unknown): boolean => typeof x === 'number' && Math.abs(x) <= limit;
    if (!Array.isArray(found) || found.length !== 3 || !found.every(good)) this.refuse(key, 'three numbers');
    return found as Vec3;
  }
  entries(): [string, Reader][] {
    return Object.keys(this.value).map((key) => [key, this.part(key)]);
  }
  text(key: string, pattern: RegExp): string {
    const found = this.value[key];
    if (typeof found !== 'string' || !pattern.test(found)) this.refuse(key, `a text like ${pattern.source}`);
    return found;
  }
}

function atlas(r: Reader): Atlas {
  const side = 1 << 20;
  return {
    format: r.choice('format', ['bc7', 'uint8', 'fp16']),
    width: r.whole('width', 1, side),
    height: r.whole('height', 1, side),
    layers: r.whole('layers', 1, side),
    extent: r.has('extent') ? r.number('extent', 1e-6, 16) : 3,
    offset: r.number('offset', -256, 256),
    scale: r.number('scale', 0, 512),
  };
}

export function parseManifest(text: string): Manifest {
  let json: unknown;
  try {
    json = JSON.parse(text);
  } catch {
    throw new DamagedBundle('bundle.json cannot be read as JSON.');
  }
  if (typeof json !== 'object' || json === null || (json as Json).format !== FORMAT) {
    throw new ViewerError('This is not a bundle', `bundle.json has not the format ${FORMAT}.`, 'Open another folder.');
  }
  const root = new Reader(json as Json, '');
  const version = root.text('version', /^[0-9]{1,6}\.[0-9]{1,6}$/);
  if (Number(version.split('.')[0]) > NEWEST_MAJOR) {
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
  const files = root.part('files').entries();
  return {
    version,
    count: surfels.whole('count', 0, 2 ** 28),
    viewColor: surfels.choice('view_color', ['sv', 'sh', 'sb', 'sg']),
    terms: surfels.has('terms') ? surfels.whole('terms', 0, 2 ** 31) : null,
    atlas: root.has('atlas') ? atlas(root.part('atlas')) : null,
    near: render.number('near', 1e-9, 1e6),
    weightBound: render.number('weight_bound', 0, 1),
    throughPixel: render.has('prefilter') && render.choice('prefilter', ['low_pass', 'pixel']) === 'pixel',
    background: render.point('background', 1),
    bounds: { min: bounds.point('min', 1e9), max: bounds.point('max', 1e9) },
    up: world?.has('up') ? world.point('up', 2) : null,
    files: new Map(
      files.map(([name, r]) => [
        name,
        { bytes: r.whole('bytes', 0, 2 ** 50), sha256: r.text('sha256', /^[0-9a-f]{64}$/) },
      ]),
    ),
  };
}
