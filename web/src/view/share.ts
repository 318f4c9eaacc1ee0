// A view as the fragment of an address, and back.
import type { Vec3 } from '../bundle/manifest';
import { SHOW, type Show } from '../render/programs';
import type { Lens, Pose } from './pose';
import { cross, dot, length } from './vector';

export interface Shared {
  pose: Pose;
  lens: Lens;
  target: Vec3;
  show: Show;
  residuals: boolean;
}

const round = (x: number): string => String(Number(x.toPrecision(9)));
const numbers = (text: string | null, count: number): number[] | null => {
  const found = (text ?? '').split(',').map(Number);
  return text !== null && found.length === count && found.every(Number.isFinite) ? found : null;
};

export function toHash({ pose, lens, target, show, residuals }: Shared): string {
  const part = (key: string, values: number[]): string => `${key}=${values.map(round).join(',')}`;
  const parts = [
    part('p', pose.position),
    part('r', [...pose.right, ...pose.forward]),
    part('t', target),
    part('l', [lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height]),
  ];
  if (show !== 'color') parts.push(`show=${show}`);
  if (!residuals) parts.push('texture=off');
  return `#${parts.join('&')}`;
}

export function fromHash(hash: string): Shared | null {
  const given = new URLSearchParams(hash.replace(/^#/, ''));
  const position = numbers(given.get('p'), 3);
  const axes = numbers(given.get('r'), 6);
  const target = numbers(given.get('t'), 3);
  const l = numbers(given.get('l'), 6);
  if (!position || !axes || !target || !l || !l.every((x, k) => k === 2 || k === 3 || x > 0)) return null;
  const [right, forward] = [axes.slice(0, 3) as Vec3, axes.slice(3) as Vec3];
  const square = Math.abs(length(right) - 1) < 1e-3 && Math.abs(length(forward) - 1) < 1e-3;
  if (!square || Math.abs(dot(right, forward)) > 1e-3) return null;
  const show = given.get('show') ?? 'color';
  const [fx, fy, cx, cy, width, height] = l;
  return {
    pose: { position: position as Vec3, right, down: cross(forward, right), forward },
    lens: { fx, fy, cx, cy, width, height },
    target: target as Vec3,
    show: show in SHOW ? (show as Show) : 'color',
    residuals: given.get('texture') !== 'off',
  };
}
