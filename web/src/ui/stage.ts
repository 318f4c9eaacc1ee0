// Interface of the viewer to its panels.
import type { Depths } from '../render/renderer';
import type { View } from '../view/pose';
import type { Shared, Viewpoint } from '../view/share';

export interface Stage {
  readonly coarse: boolean; // see Renderer
  shared(): Shared;
  // The target is by default ahead, at the distance of the cameras' common target, or else at the size of the scene.
  go(to: Omit<Viewpoint, 'target'> & Partial<Viewpoint>): void;
  fly(to: Viewpoint): void; // animated, until the user moves the camera
  pixels(): [number, number]; // of the canvas
  view(): View; // on the canvas
  hide(kept: Uint8Array | null): void; // surfels whose entry is 0; null: none
  depths(view: View): Promise<Depths>;
  fileName(ending: string): string;
}
