// The way from one view to another.
import type { Viewpoint } from './share';
import { CameraPath } from './path';
import type { View } from './pose';

const SECONDS = 0.8;

export class Flight {
  private readonly path = new CameraPath();
  private since: number | null = null; // time, ms, of the first view

  constructor(
    from: Viewpoint,
    readonly to: Viewpoint,
  ) {
    this.path.keyframes = [from, to].map(({ pose, lens }) => ({ pose, lens, seconds: SECONDS }));
  }

  // The view at a time, of a picture of so many pixels; null at the end.
  at(now: number, width: number, height: number): View | null {
    this.since ??= now;
    const t = (now - this.since) / (1000 * SECONDS);
    return t < 1 ? this.path.at(SECONDS * t * t * (3 - 2 * t), width, height) : null;
  }
}
