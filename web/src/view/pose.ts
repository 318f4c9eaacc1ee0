// Camera pose and lens.
import type { Vec3 } from '../bundle/manifest';
import { add, cross, dot, length, subtract, times, turned, unit } from './vector';

export interface Pose {
  position: Vec3;
  right: Vec3; // rows of the rotation from the world to the camera: x right, y down, z forward
  down: Vec3;
  forward: Vec3;
}

// Pinhole intrinsics for an image of `width` x `height`.
export interface Lens {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
}

const NEAR = 1e-3; // depth at which lines end, as a share of that of their farther end

function inCamera({ position, right, down, forward }: Pose, point: Vec3): Vec3 {
  const from = subtract(point, position);
  return [dot(from, right), dot(from, down), dot(from, forward)];
}

export class View implements Lens {
  constructor(
    readonly pose: Pose,
    readonly fx: number,
    readonly fy: number,
    readonly cx: number,
    readonly cy: number,
    readonly width: number,
    readonly height: number,
  ) {}

  scaledTo(width: number, height: number): View {
    const [x, y] = [width / this.width, height / this.height];
    return new View(this.pose, this.fx * x, this.fy * y, this.cx * x, this.cy * y, width, height);
  }
  // Moves the origin of the world's frame.
  from(origin: Vec3): View {
    const pose = { ...this.pose, position: subtract(this.pose.position, origin) };
    return new View(pose, this.fx, this.fy, this.cx, this.cy, this.width, this.height);
  }
  // Crops the view; right and bottom are exclusive.
  part(left: number, top: number, right: number, bottom: number): View {
    return new View(this.pose, this.fx, this.fy, this.cx - left, this.cy - top, right - left, bottom - top);
  }
  // Projects a point to pixel coordinates and depth along the camera's axis; null outside the picture.
  project(point: Vec3): Vec3 | null {
    const [across, down, z] = inCamera(this.pose, point);
    const x = (this.fx * across) / z + this.cx;
    const y = (this.fy * down) / z + this.cy;
    return z > 0 && x >= 0 && x < this.width && y >= 0 && y < this.height ? [x, y, z] : null;
  }
  // Projects the part of a line in front of the camera: pixel coordinates of its ends; null if there is none.
  segment(a: Vec3, b: Vec3): [number, number, number, number] | null {
    const [p, q] = [a, b].map((at) => inCamera(this.pose, at));
    const near = NEAR * Math.max(Math.abs(p[2]), Math.abs(q[2]));
    if (Math.max(p[2], q[2]) < near || !near) return null;
    const pixel = (end: Vec3, other: Vec3): [number, number] => {
      const share = end[2] < near ? (near - end[2]) / (other[2] - end[2]) : 0;
      const [x, y, z] = add(end, times(share, subtract(other, end)));
      return [(this.fx * x) / z + this.cx, (this.fy * y) / z + this.cy];
    };
    return [...pixel(p, q), ...pixel(q, p)];
  }
  // Fits a lens into a screen, showing more on two sides.
  static contain(pose: Pose, lens: Lens, width: number, height: number): View {
    const k = Math.min(width / lens.width, height / lens.height);
    const cx = width / 2 + k * (lens.cx - lens.width / 2);
    const cy = height / 2 + k * (lens.cy - lens.height / 2);
    return new View(pose, k * lens.fx, k * lens.fy, cx, cy, width, height);
  }
}

export const DEFAULT_LENS: Lens = { fx: 1000, fy: 1000, cx: 500, cy: 500, width: 1000, height: 1000 };

export function lookAt(position: Vec3, target: Vec3, up: Vec3): Pose {
  const forward = unit(subtract(target, position));
  const side = cross(forward, up);
  const right = unit(length(side) > 1e-6 ? side : cross(forward, [up[1], up[2], up[0]]));
  return { position, right, down: cross(forward, right), forward };
}

function turnedPose(pose: Pose, axis: Vec3, angle: number): Pose {
  return {
    position: pose.position,
    right: turned(pose.right, axis, angle),
    down: turned(pose.down, axis, angle),
    forward: turned(pose.forward, axis, angle),
  };
}

const STEEPEST = 0.998; // largest cosine between view and vertical when tilting

// Whether a camera may tilt without coming too close to the vertical or turning over.
function tilts(pose: Pose, up: Vec3, angle: number): boolean {
  const next = turnedPose(pose, pose.right, angle);
  const [before, after] = [Math.abs(dot(pose.forward, up)), Math.abs(dot(next.forward, up))];
  return (after < STEEPEST || after < before) && dot(pose.down, up) * dot(next.down, up) > 0;
}

// Rotates the camera in place: `across` to the right, `upwards` towards the sky, radians.
export function look(pose: Pose, up: Vec3, across: number, upwards: number): Pose {
  const aside = turnedPose(pose, up, -across);
  return tilts(aside, up, upwards) ? turnedPose(aside, aside.right, upwards) : aside;
}

// Orbits a point, which keeps its position on the screen.
export function orbit(pose: Pose, target: Vec3, up: Vec3, across: number, upwards: number): Pose {
  const from = inCamera({ ...pose, position: target }, pose.position);
  return moved({ ...look(pose, up, across, upwards), position: target }, ...from);
}

export function moved(pose: Pose, right: number, down: number, forward: number): Pose {
  const step = add(add(times(right, pose.right), times(down, pose.down)), times(forward, pose.forward));
  return { ...pose, position: add(pose.position, step) };
}

export function rolled(pose: Pose, angle: number): Pose {
  return turnedPose(pose, pose.forward, angle);
}
