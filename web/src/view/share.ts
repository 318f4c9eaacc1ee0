// Conversion of views to and from address fragments.
import type { Vec3 } from '../bundle/manifest';
import { SHOW, type Show } from '../render/programs';
import type { Lens, Pose } from './pose';
import { cross, dot, length } from './vector';

// A camera and its orbit centre.
export interface Viewpoint {
  pose: Pose;
  lens: Lens;
  target: Vec3;
}

export interface Shared extends Viewpoint {
  show: Show;
  residuals: boolean;
}

export const lensOf = (l: Lens): number[] => [l.fx, l.fy, l.cx, l.cy, l.width, l.height];
const round = (x: number): string => String(Number(x.toPrecision(9)));
const numbers = (text: string | null, count: number): number[] | null => {
  const list = (text ?? '').split(',').map(Number);
  return text !== null && list.length === count && list.every(Number.isFinite) ? list : null;
};

export function toHash({ pose, lens, target, show, residuals }: Shared): string {
  const part = (key: string, values: number[]): string => `${key}=${values.map(round).join(',')}`;
  const parts = [
    part('p', pose.position),
    part('r', [...pose.right, ...pose.forward]),
    part('t', target),
    part('l', lensOf(lens)),
  ];
  if (show !== 'color') parts.push(`show=${show}`);
  if (!residuals) parts.push('texture=off');
  return `#${parts.join('&')}`;
}

// A camera in messages.
export const cameraOf = ({ pose: { position, right, forward }, lens, target }: Viewpoint) => {
  return { position, right, forward, target, lens: lensOf(lens) };
};
export type Camera = ReturnType<typeof cameraOf>;

const FARTHEST = 1e9;

// Null if invalid.
export function viewpointOf(camera: unknown): Viewpoint | null {
  const given = (camera ?? {}) as Partial<Record<keyof Camera, unknown>>;
  const good = (list: unknown, count: number): list is number[] =>
    Array.isArray(list) && list.length === count && list.every((x) => Number.isFinite(x) && Math.abs(x) <= FARTHEST);
  const { position, right, forward, target, lens } = given;
  if (![position, right, forward, target].every((list) => good(list, 3)) || !good(lens, 6)) return null;
  if (!lens.every((x, k) => k === 2 || k === 3 || x > 0)) return null;
  const [x, z] = [right as Vec3, forward as Vec3];
  const square = Math.abs(length(x) - 1) < 1e-3 && Math.abs(length(z) - 1) < 1e-3;
  if (!square || Math.abs(dot(x, z)) > 1e-3) return null;
  const [fx, fy, cx, cy, width, height] = lens;
  return {
    pose: { position: position as Vec3, right: x, down: cross(z, x), forward: z },
    lens: { fx, fy, cx, cy, width, height },
    target: target as Vec3,
  };
}

export function fromHash(hash: string): Shared | null {
  const given = new URLSearchParams(hash.replace(/^#/, ''));
  const [position, axes] = [numbers(given.get('p'), 3), numbers(given.get('r'), 6)];
  const [right, forward] = [axes?.slice(0, 3), axes?.slice(3)];
  const [target, lens] = [numbers(given.get('t'), 3), numbers(given.get('l'), 6)];
  const viewpoint = viewpointOf({ position, right, forward, target, lens });
  const asked = given.get('show') ?? 'color';
  const show = asked in SHOW ? (asked as Show) : 'color';
  return viewpoint && { ...viewpoint, show, residuals: given.get('texture') !== 'off' };
}
