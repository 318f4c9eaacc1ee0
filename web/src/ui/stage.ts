// What the panels see and change of what is shown.
import type { Vec3 } from '../bundle/manifest';
import type { Depths } from '../render/renderer';
import type { Viewpoint } from '../view/notes';
import type { Lens, Pose, View } from '../view/pose';
import type { Shared } from '../view/share';

export interface Stage {
  shared(): Shared;
  go(pose: Pose, lens: Lens, target?: Vec3): void;
  fly(to: Viewpoint): void; // on the way there, as long as the reader does not move the camera
  pixels(): [number, number]; // of the canvas
  view(): View; // that the canvas shows
  depths(view: View): Promise<Depths>;
  fileName(ending: string): string;
}
