// Unit quaternions w, x, y, z, and their logarithms: rotation vectors of half the angle.
import type { Vec3 } from '../bundle/manifest';
import type { Pose } from './pose';
import { cross, length, times, unit } from './vector';

export type Quat = [number, number, number, number];

export const product = ([a, b, c, d]: Quat, [e, f, g, h]: Quat): Quat => [
  a * e - b * f - c * g - d * h,
  a * f + b * e + c * h - d * g,
  a * g - b * h + c * e + d * f,
  a * h + b * g - c * f + d * e,
];

export function exponential(v: Vec3): Quat {
  const angle = length(v);
  return [Math.cos(angle), ...times(angle > 1e-9 ? Math.sin(angle) / angle : 1, v)];
}

// Computes the logarithm of the shorter rotation from a to b, in the frame of a.
export function difference(a: Quat, b: Quat): Vec3 {
  const [w, x, y, z] = product([a[0], -a[1], -a[2], -a[3]], b);
  const sine = Math.hypot(x, y, z);
  const sign = w < 0 ? -1 : 1;
  return times(sine > 1e-9 ? (sign * Math.atan2(sine, Math.abs(w))) / sine : sign, [x, y, z]);
}

export const slerp = (a: Quat, b: Quat, t: number): Quat => product(a, exponential(times(t, difference(a, b))));

// Converts a pose to its camera-to-world rotation, whose columns are right, down and forward.
export function quatOf({ right: r, down: d, forward: f }: Pose): Quat {
  const squares = [1 + r[0] + d[1] + f[2], 1 + r[0] - d[1] - f[2], 1 - r[0] + d[1] - f[2], 1 - r[0] - d[1] + f[2]];
  const largest = squares.indexOf(Math.max(...squares));
  const [a, b, c] = [d[2] - f[1], f[0] - r[2], r[1] - d[0]];
  const [p, q, s] = [d[0] + r[1], f[0] + r[2], f[1] + d[2]];
  const rows: Quat[] = [
    [squares[0], a, b, c],
    [a, squares[1], p, q],
    [b, p, squares[2], s],
    [c, q, s, squares[3]],
  ];
  const k = 1 / Math.hypot(...rows[largest]);
  return rows[largest].map((x) => k * x) as Quat;
}

// Converts a rotation to the axes of its frame.
export const axesOf = ([w, x, y, z]: Quat): [Vec3, Vec3, Vec3] => [
  [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
  [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
  [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
];

// Returns a rotation whose third axis points upwards.
export function uprightQuat(up: Vec3): Quat {
  const forward = unit(up);
  const right = unit(cross(forward, Math.abs(forward[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  return quatOf({ position: [0, 0, 0], right, down: cross(forward, right), forward });
}

export function poseOf(position: Vec3, quat: Quat): Pose {
  const [right, down, forward] = axesOf(quat);
  return { position, right, down, forward };
}
