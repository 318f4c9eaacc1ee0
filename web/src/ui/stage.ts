// What the panels see and change of what is shown.
import type { Depths } from '../render/renderer';
import type { View } from '../view/pose';
import type { Shared, Viewpoint } from '../view/share';

export interface Stage {
  shared(): Shared;
  go(to: Omit<Viewpoint, 'target'> & Partial<Viewpoint>): void; // by default the target is one ahead
  fly(to: Viewpoint): void; // on the way there, as long as the reader does not move the camera
  pixels(): [number, number]; // of the canvas
  view(): View; // that the canvas shows
  depths(view: View): Promise<Depths>;
  fileName(ending: string): string;
}
