import { describe, expect, it } from 'vitest';
import type { Vec3 } from '../src/bundle/manifest';
import { edgesOf } from '../src/ui/stage';
import { lengthText } from '../src/ui/measure_panel';
import type { Box } from '../src/view/crop';
import { View, lookAt } from '../src/view/pose';
import { axesOf, uprightQuat } from '../src/view/rotation';
import { cross, dot, length, subtract, unit } from '../src/view/vector';

describe('lengths', () => {
  it.each([
    [0.5, { name: 'm', perWorld: 2.46913 }, '1.235 m'],
    [0.5, { name: 'm', perWorld: 2 }, '1 m'],
    [1e-5, { name: 'units', perWorld: 1 }, '0.00001 units'],
    [123456, { name: 'km', perWorld: 1 }, '123500 km'],
  ])('%d of the scene are shown', (world, unitOf, text) => {
    expect(lengthText(world, unitOf)).toBe(text);
  });
});

describe('lines', () => {
  const view = new View(lookAt([0, -4, 0], [0, 0, 0], [0, 0, 1]), 100, 100, 50, 40, 100, 80);
  it('are drawn from end to end, beyond the picture, too', () => {
    expect(view.segment([-1, 0, 0], [1, 0, 1])).toEqual([25, 40, 75, 15].map((x) => expect.closeTo(x) as number));
    expect(view.segment([-8, 0, 0], [8, 0, 0])?.[0]).toBeCloseTo(-150);
  });
  it('end in front of the camera', () => {
    const [x, y, u, v] = view.segment([0, 0, 1], [0, -8, 1]) ?? [];
    expect([x, y, u]).toEqual([50, 15, 50].map((number) => expect.closeTo(number) as number));
    expect(v).toBeLessThan(-1000);
    expect(view.segment([0, -5, 0], [1, -6, 0])).toBeNull();
    expect(view.segment([0, -4, 0], [0, -4, 0])).toBeNull();
  });
  it('are the twelve edges of a box', () => {
    const box: Box = { center: [1, 2, 3], half: [1, 2, 3], quat: [1, 0, 0, 0] };
    const edges = edgesOf(box);
    const lengths = edges.map(([a, b]) => length(subtract(a, b))).sort((a, b) => a - b);
    expect(lengths).toEqual([2, 2, 2, 2, 4, 4, 4, 4, 6, 6, 6, 6]);
    expect(new Set(edges.flat().map(String)).size).toBe(8);
    for (const corner of edges.flat()) corner.forEach((x, k) => expect(Math.abs(x - box.center[k])).toBe(box.half[k]));
  });
});

describe('upright boxes', () => {
  it.each<Vec3>([
    [0, 0, 1],
    [0, -1, 0],
    [1, 0, 0],
    [0, 0, -1],
    [0.3, -0.5, 0.8],
  ])('have %d, %d, %d for their third axis', (...up) => {
    const [a, b, c] = axesOf(uprightQuat(up));
    unit(up).forEach((x, k) => expect(c[k]).toBeCloseTo(x));
    expect(dot(cross(a, b), c)).toBeCloseTo(1);
    expect(dot(a, b)).toBeCloseTo(0);
  });
});
