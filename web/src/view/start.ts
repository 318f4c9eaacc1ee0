// First view without cameras, and the size of the scene.
import type { Vec3 } from '../bundle/manifest';
import { type Surfels } from '../bundle/surfels';
import { SURFEL_WORDS } from '../bundle/tables';
import { type Pose, lookAt } from './pose';
import { add, cross, length, times, unit } from './vector';

const SAMPLES = 4000;

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
