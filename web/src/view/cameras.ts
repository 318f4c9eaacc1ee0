// Cameras of the capture, from the optional cameras.json; the first view without any, and the size of the scene.
import type { Vec3 } from '../bundle/manifest';
import type { Surfels } from '../bundle/surfels';
import { SURFEL_WORDS } from '../bundle/tables';
import { type Lens, type Pose, lookAt } from './pose';
import { add, cross, dot, length, subtract, times, unit } from './vector';

const FILE = /^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$/;
const MOST = 100_000;
const SAME = 1e-6; // difference of equal poses, relative

const isNumber = (x: unknown): x is number => typeof x === 'number' && Number.isFinite(x);

function correctionOf(stored: unknown): number[] | null {
  if (!Array.isArray(stored) || !stored.every(isNumber)) return null;
  if (stored.length === 3) return stored.flatMap((gain, c) => [0, 1, 2, 3].map((k) => (k === c ? gain : 0)));
  return stored.length === 12 ? stored : null;
}

function camera(row: unknown) {
  if (typeof row !== 'object' || row === null) return null;
  const r = row as Record<string, unknown>;
  const [m, fx, fy, cx, cy, width, height] = [r.viewmat, r.fx, r.fy, r.cx, r.cy, r.width, r.height];
  if (!Array.isArray(m) || m.length !== 16 || !m.every(isNumber)) return null;
  if (![fx, fy, cx, cy, width, height].every(isNumber) || typeof r.name !== 'string') return null;
  const lens = { fx, fy, cx, cy, width, height } as Lens;
  if (!(lens.fx > 0 && lens.fy > 0 && lens.width >= 1 && lens.height >= 1)) return null;
  const [right, down, forward] = [0, 4, 8].map((k) => m.slice(k, k + 3) as Vec3);
  const back = add(add(times(m[3], right), times(m[7], down)), times(m[11], forward));
  const photograph = typeof r.photograph === 'string' && FILE.test(r.photograph) ? r.photograph : null;
  return {
    name: r.name.slice(0, 200),
    heldOut: r.held_out === true,
    pose: { position: times(-1, back), right, down, forward },
    lens,
    photograph, // file in the bundle, or null
    correction: correctionOf(r.correction), // of the scene's colours to the photograph's: matrix and offset [3, 4]
  };
}
export type CaptureCamera = NonNullable<ReturnType<typeof camera>>;

export function parseCameras(text: string): CaptureCamera[] {
  let json: unknown;
  try {
    json = JSON.parse(text);
  } catch {
    return [];
  }
  const rows = (json as { cameras?: unknown } | null)?.cameras;
  if (!Array.isArray(rows)) return [];
  return rows
    .slice(0, MOST)
    .map(camera)
    .filter((found) => found !== null);
}

// Null without a camera of that pose, or if it has none.
export function correctionAt(cameras: CaptureCamera[], pose: Pose): number[] | null {
  const same = (a: Vec3, b: Vec3): boolean => length(subtract(a, b)) < SAME * (1 + length(b));
  const there = cameras.find(
    ({ pose: p }) => same(pose.position, p.position) && same(pose.right, p.right) && same(pose.forward, p.forward),
  );
  return there?.correction ?? null;
}

// Computes the point nearest to all optical axes by least squares; null if they are parallel.
export function commonTarget(cameras: CaptureCamera[]): Vec3 | null {
  // sum over cameras of (1 - f f^T) (x - p) = 0
  const a = [0, 0, 0, 0, 0, 0, 0, 0, 0];
  let b: Vec3 = [0, 0, 0];
  for (const { pose } of cameras) {
    const f = pose.forward;
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) a[3 * i + j] += (i === j ? 1 : 0) - f[i] * f[j];
    b = add(b, subtract(pose.position, times(dot(f, pose.position), f)));
  }
  const column = (k: number): Vec3 => [a[k], a[3 + k], a[6 + k]];
  const det3 = (p: Vec3, q: Vec3, r: Vec3): number =>
    p[0] * (q[1] * r[2] - q[2] * r[1]) + p[1] * (q[2] * r[0] - q[0] * r[2]) + p[2] * (q[0] * r[1] - q[1] * r[0]);
  const det = det3(column(0), column(1), column(2));
  if (!(Math.abs(det) > 1e-4 * cameras.length ** 3)) return null;
  return [
    det3(b, column(1), column(2)) / det,
    det3(column(0), b, column(2)) / det,
    det3(column(0), column(1), b) / det,
  ];
}

const SAMPLES = 4000; // surfels whose positions tell the size

// Computes the surfels' median position and twice the median distance to it, robust to far surfels.
export function extentOf(surfels: Surfels): { middle: Vec3; size: number } {
  const step = Math.max(1, Math.floor(surfels.count / SAMPLES));
  const rows: Vec3[] = [];
  for (let i = 0; i < surfels.count; i += step) {
    const at = i * SURFEL_WORDS;
    rows.push([surfels.words[at], surfels.words[at + 1], surfels.words[at + 2]]);
  }
  if (!rows.length) return { middle: [0, 0, 0], size: 1 };
  const median = (values: number[]): number => values.sort((a, b) => a - b)[values.length >> 1];
  const middle = [0, 1, 2].map((c) => median(rows.map((row) => row[c]))) as Vec3;
  const size = median(rows.map((row) => length([row[0] - middle[0], row[1] - middle[1], row[2] - middle[2]])));
  return { middle: add(middle, surfels.origin), size: Math.max(2 * size, 1e-6) };
}

// Chooses the first pose. The scene frame's origin is the mean of the cameras, the farthest of which is about 1
// away. So a scene on one side is viewed from the origin's side, and a scene around the origin from the side.
export function firstPose(middle: Vec3, size: number, up: Vec3): Pose {
  const distance = Math.min(Math.max(1, 0.5 * size), 1.6 * size);
  const across = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  const aside = unit(add(across, times(0.3, up)));
  const away = length(middle) > 0.5 * distance ? unit(times(-1, middle)) : aside;
  return lookAt(add(middle, times(distance, away)), middle, up);
}
