// What the panels see and change of what is shown.
import type { Vec3 } from '../bundle/manifest';
import type { Lens, Pose } from '../view/pose';
import type { Shared } from '../view/share';

export interface Stage {
  shared(): Shared;
  go(pose: Pose, lens: Lens, target?: Vec3): void;
  pixels(): [number, number]; // of the canvas
  fileName(ending: string): string;
}
