// Lines over the scene.
import type { Vec3 } from '../bundle/manifest';
import type { Box } from '../view/crop';
import type { View } from '../view/pose';
import { axesOf } from '../view/rotation';
import { add, times } from '../view/vector';
import { element } from './dom';

export type Line = [Vec3, Vec3];

const SVG = 'http://www.w3.org/2000/svg';

// A set of lines of one style.
export class Lines {
  private readonly path = document.createElementNS(SVG, 'path');

  constructor(style: string) {
    this.path.setAttribute('class', style);
    element('lines').append(this.path);
  }

  draw(view: View, lines: Line[]): void {
    const parts = lines.map(([a, b]) => view.segment(a, b)).filter((part) => part !== null);
    this.path.setAttribute('d', parts.map(([x, y, u, v]) => `M${x} ${y}L${u} ${v}`).join(''));
    this.path.ownerSVGElement?.setAttribute('viewBox', `0 0 ${view.width} ${view.height}`);
  }
}

export function edgesOf({ center, half, quat }: Box): Line[] {
  const sides = axesOf(quat).map((axis, k) => times(half[k], axis));
  const corner = (k: number): Vec3 =>
    sides.reduce((at, side, axis) => add(at, times(k & (1 << axis) ? 1 : -1, side)), center);
  const from = (axis: number): number[] => [0, 1, 2, 3, 4, 5, 6, 7].filter((k) => !(k & (1 << axis)));
  return [0, 1, 2].flatMap((axis) => from(axis).map((k): Line => [corner(k), corner(k | (1 << axis))]));
}
