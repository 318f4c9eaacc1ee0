// Sampling of views of another size than the photographs, as bitymi_ns/scene/sampling.py.
import type { Vec3 } from '../bundle/manifest';
import { SURFEL_WORDS, WORD } from '../bundle/tables';
import type { View } from './pose';
import { dot } from './vector';

const AS_TRAINED = [0.75, 1.5]; // sizes drawn as in training
const [SMALLEST, LARGEST] = [0.5, 2]; // beyond, fully adapted; blended in between
const [ONE_SAMPLE, TWO_SAMPLES] = [0.6, 1 / 3]; // from these sizes on one sample per pixel, or two along each axis
const SAMPLE = 0.58; // least width of a photograph's pixel in smaller views, samples
const FARTHEST = [1 / 64, 64];
const SUPPORT = 3; // discs end there, in their scales
const RIM = 3; // pixels around discs that the low pass and wider kernels may reach

export type Part = [left: number, top: number, right: number, bottom: number]; // of a picture, in pixels

// Computes the size of a view relative to the photographs. `photographed` has rows x, y, z, rate.
export function sizeOf(photographed: Float32Array, view: View): number {
  const sizes: number[] = [];
  for (let i = 0; i < photographed.length; i += 4) {
    const at = view.project([photographed[i], photographed[i + 1], photographed[i + 2]]);
    if (at) sizes.push(Math.sqrt(view.fx * view.fy) / (at[2] * photographed[i + 3]));
  }
  if (!sizes.length) return 1;
  sizes.sort((a, b) => a - b);
  return Math.min(Math.max(sizes[(sizes.length - 1) >> 1], FARTHEST[0]), FARTHEST[1]);
}

// Whether a view of that size is cropped to `partOf`.
export const isFar = (size: number): boolean => size < TWO_SAMPLES;

// Bounds the pixels in which surfels can be seen, by spheres around their discs; at least one pixel.
export function partOf(words: Float32Array, view: View, near: number): Part {
  const { position, right, down, forward } = view.pose; // relative to the surfels' origin
  const [low, high] = [
    [Infinity, Infinity],
    [-Infinity, -Infinity],
  ];
  for (let i = 0; i < words.length; i += SURFEL_WORDS) {
    const from: Vec3 = [words[i] - position[0], words[i + 1] - position[1], words[i + 2] - position[2]];
    const z = dot(from, forward);
    if (!(z > near)) continue;
    const radius = SUPPORT * Math.exp(Math.max(words[i + WORD.logScale], words[i + WORD.logScale + 1]));
    for (const [axis, row] of [right, down].entries()) {
      const at = dot(from, row) / z;
      const half = z > radius ? (radius * (1 + Math.abs(at))) / (z - radius) : Infinity;
      low[axis] = Math.min(low[axis], at - half);
      high[axis] = Math.max(high[axis], at + half);
    }
  }
  const side = (axis: number, focal: number, middle: number, pixels: number): [number, number] => {
    const first = Math.floor(Math.min(Math.max(low[axis] * focal + middle - RIM, 0), pixels - 1));
    return [first, Math.ceil(Math.max(Math.min(high[axis] * focal + middle + RIM, pixels), first + 1))];
  };
  const [left, end] = side(0, view.fx, view.cx, view.width);
  const [top, bottom] = side(1, view.fy, view.cy, view.height);
  return [left, top, end, bottom];
}

// Chooses the samples per pixel and axis of a view with `pixels`, and with them the side of a photograph's pixel in
// samples; at most `mostSamples` per pixel and axis, and `mostPixels` in all.
export function samplingOf(size: number, pixels: number, mostSamples: number, mostPixels: number) {
  const [low, high] = AS_TRAINED;
  if (low <= size && size <= high) return { samples: 1, photoPixel: 1 };
  const room = Math.floor(Math.sqrt(mostPixels / Math.max(pixels, 1)));
  const wanted = size >= ONE_SAMPLE ? 1 : size >= TWO_SAMPLES ? 2 : Math.max(3, Math.ceil(SAMPLE / size));
  const samples = Math.max(1, Math.min(wanted, mostSamples, room));
  let photoPixel = samples * size;
  if (samples > 1) return { samples, photoPixel };
  if (SMALLEST < size && size < low) photoPixel = SMALLEST ** (Math.log(low / size) / Math.log(low / SMALLEST));
  else if (high < size && size < LARGEST) photoPixel = LARGEST ** (Math.log(size / high) / Math.log(LARGEST / high));
  return { samples, photoPixel };
}
