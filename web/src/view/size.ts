// Sampling of views of another size than the photographs, as bitymi_ns/scene/sampling.py.
import type { View } from './pose';

const AS_TRAINED = [0.75, 1.5]; // sizes drawn as in training
const [SMALLEST, LARGEST] = [0.5, 2]; // beyond, fully adapted; blended in between
const [ONE_SAMPLE, TWO_SAMPLES] = [0.6, 1 / 3]; // from these sizes on one sample per pixel, or two along each axis
const SAMPLE = 0.58; // least width of a photograph's pixel in smaller views, samples
const FARTHEST = [1 / 64, 64];

export interface Sampling {
  samples: number; // per pixel, along each axis
  photoPixel: number; // side of a photograph's pixel in samples
}

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

// Chooses the sampling of a view with `pixels`; at most `mostSamples` per pixel and axis, and `mostPixels` in all.
export function samplingOf(size: number, pixels: number, mostSamples: number, mostPixels: number): Sampling {
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
