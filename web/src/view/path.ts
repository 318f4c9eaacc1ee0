// Camera path through keyframes, and its file for `ns-render camera-path`.
import type { Vec3 } from '../bundle/manifest';
import { type Lens, type Pose, View } from './pose';
import { type Quat, difference, exponential, poseOf, product, quatOf, slerp } from './rotation';
import { type Viewpoint, lensOf, viewpointOf } from './share';
import { add, dot, length, subtract, times } from './vector';

export interface Keyframe {
  pose: Pose;
  lens: Lens;
  seconds: number; // to the next keyframe
}

export const SHORTEST = 0.1; // seconds of a segment
export const LONGEST = 600;
export const SECONDS = 2; // of a new segment
export const RATE = 30; // frames per second of the file
const MOST_FRAMES = 36_000; // of the file: 20 minutes
const MOST_KEYFRAMES = 1000; // in a file
const FLIGHT_SECONDS = 0.8;
const STEEPEST = 3; // times the slower of two segments: steeper tangents overshoot

export class CameraPath {
  keyframes: Keyframe[] = [];
  smooth = true;
  loop = false;

  private get segments(): number {
    return this.keyframes.length < 2 ? 0 : this.keyframes.length - (this.loop ? 0 : 1);
  }
  get seconds(): number {
    return this.keyframes.slice(0, this.segments).reduce((sum, { seconds }) => sum + seconds, 0);
  }
  // Scales all segments to a total duration.
  set seconds(wanted: number) {
    const k = wanted / this.seconds;
    for (const keyframe of this.keyframes) keyframe.seconds = within(k * keyframe.seconds);
  }

  // Needs two keyframes.
  at(time: number, width: number, height: number): View {
    let [segment, rest] = [0, Math.min(Math.max(time, 0), this.seconds)];
    while (segment + 1 < this.segments && rest >= this.keyframes[segment].seconds) {
      rest -= this.keyframes[segment++].seconds;
    }
    const last = this.keyframes.length;
    const [from, to] = [this.keyframes[segment], this.keyframes[(segment + 1) % last]];
    const h = from.seconds;
    const t = rest / h;
    const shown = ({ pose, lens }: Keyframe): View => View.contain(pose, lens, width, height);
    const focal = (k: Keyframe): Vec3 => [Math.log(shown(k).fx), Math.log(shown(k).fy), 0];
    const middle = (k: Keyframe): Vec3 => [shown(k).cx, shown(k).cy, 0];
    const place = ({ pose }: Keyframe): Vec3 => pose.position;
    const along = (value: (k: Keyframe) => Vec3): Vec3 => {
      const speeds = this.speeds(segment, (a, b) => subtract(value(b), value(a)));
      return hermite(value(from), value(to), times(h, speeds[0]), times(h, speeds[1]), t);
    };
    const turns = this.speeds(segment, (a, b) => difference(quatOf(a.pose), quatOf(b.pose)));
    const rotation = bezier(quatOf(from.pose), quatOf(to.pose), times(h, turns[0]), times(h, turns[1]), t);
    const [fx, fy] = along(focal).map(Math.exp);
    const [cx, cy] = along(middle);
    return new View(poseOf(along(place), rotation), fx, fy, cx, cy, width, height);
  }

  // Computes the speeds, per second, at the ends of a segment. step: difference of a value between two keyframes.
  private speeds(segment: number, step: (a: Keyframe, b: Keyframe) => Vec3): [Vec3, Vec3] {
    const count = this.keyframes.length;
    const speed = (k: number): Vec3 | null => {
      const i = this.loop ? (k + count) % count : k;
      if (i < 0 || i >= this.segments) return null;
      return times(1 / this.keyframes[i].seconds, step(this.keyframes[i], this.keyframes[(i + 1) % count]));
    };
    const own = speed(segment)!;
    const joined = (k: number): Vec3 => {
      const [a, b] = [speed(k - 1), speed(k)];
      if (!this.smooth || !a || !b) return own;
      const [before, after] = [this.keyframes[(k - 1 + count) % count].seconds, this.keyframes[k % count].seconds];
      const mean = times(1 / (before + after), add(times(after, a), times(before, b)));
      const most = STEEPEST * Math.min(length(a), length(b));
      return times(Math.min(1, most / Math.max(length(mean), 1e-12)), mean);
    };
    return [joined(segment), joined(segment + 1)];
  }

  // Serialises for `ns-render camera-path`, for a picture size. Scene frame, OpenGL axes. nerfstudio ignores principal
  // points, fractional sizes, and the lens of keyframes: fx, fy, cx, cy, width, height.
  file(width: number, height: number): string {
    const { seconds } = this;
    const aspect = width / height;
    const count = Math.min(MOST_FRAMES, Math.max(2, Math.round(RATE * seconds)));
    const step = seconds / (this.loop ? count : count - 1);
    const frames = Array.from({ length: count }, (_, k) => {
      const { pose, fy, cx, cy } = this.at(k * step, width, height);
      const principal_point = [cx / width, cy / height];
      return { camera_to_world: cameraToWorld(pose), fov: fovOf(fy, height), aspect, principal_point };
    });
    const keyframes = this.keyframes.map(({ pose, lens }, k) => ({
      matrix: cameraToWorld(pose),
      fov: fovOf(View.contain(pose, lens, width, height).fy, height),
      aspect,
      override_transition_enabled: true,
      override_transition_sec: this.keyframes.at(k - 1)!.seconds, // from the previous keyframe
      lens: lensOf(lens),
    }));
    return JSON.stringify({
      keyframes,
      camera_type: 'perspective',
      render_height: height,
      render_width: width,
      camera_path: frames,
      fps: count / seconds,
      seconds,
      smoothness_value: this.smooth ? 0 : 1, // nerfstudio's tension
      is_cycle: this.loop,
      crop: null,
    });
  }

  // Reads such a file, or one of nerfstudio's viewer; throws if invalid.
  load(text: string): void {
    const file = JSON.parse(text) as Record<string, unknown> | null;
    const rows = file?.keyframes;
    if (!Array.isArray(rows) || !rows.length || rows.length > MOST_KEYFRAMES) {
      throw new Error(`it has not 1 to ${MOST_KEYFRAMES} keyframes.`);
    }
    if ((file?.camera_type ?? 'perspective') !== 'perspective') throw new Error('its cameras are not perspective.');
    const usual = secondsOf(file?.default_transition_sec) ?? SECONDS;
    const read = rows.map((row, k) => keyframeOf((row ?? {}) as Record<string, unknown>, k, usual));
    this.keyframes = read.map((keyframe, k) => ({ ...keyframe, seconds: read[(k + 1) % read.length].seconds }));
    this.smooth = file?.smoothness_value !== 1;
    this.loop = file?.is_cycle === true;
  }
}

// Animated transition between two views.
export class Flight {
  private readonly path = new CameraPath();
  private since: number | null = null; // time, ms, of the first view

  constructor(
    from: Viewpoint,
    readonly to: Viewpoint,
  ) {
    this.path.keyframes = [from, to].map(({ pose, lens }) => ({ pose, lens, seconds: FLIGHT_SECONDS }));
  }

  // Null after the end.
  at(now: number, width: number, height: number): View | null {
    this.since ??= now;
    const t = (now - this.since) / (1000 * FLIGHT_SECONDS);
    return t < 1 ? this.path.at(FLIGHT_SECONDS * t * t * (3 - 2 * t), width, height) : null;
  }
}

const fovOf = (fy: number, height: number): number => (360 / Math.PI) * Math.atan(height / 2 / fy); // degrees
export const within = (seconds: number): number => Math.min(LONGEST, Math.max(SHORTEST, seconds)); // of a segment
const secondsOf = (given: unknown): number | null => (typeof given === 'number' && given > 0 ? within(given) : null);

// Reads keyframe k of a file; its seconds count from the previous keyframe.
function keyframeOf(row: Record<string, unknown>, k: number, usual: number): Keyframe {
  const { matrix, fov, aspect, override_transition_enabled: own, override_transition_sec: seconds } = row;
  const m = Array.isArray(matrix) && matrix.length === 16 ? (matrix as number[]) : [];
  const [right, up, back, position] = [0, 1, 2, 3].map((c) => [m[c], m[c + 4], m[c + 8]] as Vec3);
  let { lens } = row;
  if (lens === undefined) {
    const [width, height] = [1000 * Number(aspect), 1000];
    const f = height / 2 / Math.tan((Math.PI / 360) * Number(fov));
    lens = [f, f, width / 2, height / 2, width, height];
  }
  const viewpoint = viewpointOf({ position, right, forward: times(-1, back), target: position, lens });
  if (!viewpoint || !(dot(viewpoint.pose.down, up) < -0.9)) throw new Error(`keyframe ${k + 1} is no camera.`);
  return { ...viewpoint, seconds: (own === true ? secondsOf(seconds) : null) ?? usual };
}

// Converts to a row-major matrix; x right, y up, z backward.
function cameraToWorld({ position, right, down, forward }: Pose): number[] {
  const row = (c: number): number[] => [right[c], -down[c], -forward[c], position[c]];
  return [...[0, 1, 2].flatMap(row), 0, 0, 0, 1];
}

// Interpolates from a to b by a cubic with end derivatives m and n.
function hermite(a: Vec3, b: Vec3, m: Vec3, n: Vec3, t: number): Vec3 {
  const s = 1 - t;
  const ends = add(times(s * s * (1 + 2 * t), a), times(t * t * (1 + 2 * s), b));
  return add(ends, add(times(s * s * t, m), times(-s * t * t, n)));
}

// Interpolates rotations by Shoemake's Bezier curve, with derivatives in the frames of its ends.
function bezier(a: Quat, b: Quat, m: Vec3, n: Vec3, t: number): Quat {
  let points = [a, product(a, exponential(times(1 / 3, m))), product(b, exponential(times(-1 / 3, n))), b];
  while (points.length > 1) points = points.slice(1).map((q, k) => slerp(points[k], q, t));
  return points[0];
}
