// Crops of a scene: surfels are kept or hidden by their centres, as in bitymi_ns/scene/crop.py.
import type { Vec3 } from '../bundle/manifest';
import { type Surfels } from '../bundle/surfels';
import { SURFEL_WORDS, WORD } from '../bundle/tables';
import { type Quat, axesOf } from './rotation';
import { dot, subtract } from './vector';

// Box whose axes are those of the rotation `quat`.
export interface Box {
  center: Vec3;
  half: Vec3;
  quat: Quat;
}
// Plane normal . x = offset.
export interface Floor {
  normal: Vec3;
  offset: number;
}
export interface Cropping {
  crop: { box?: Box; floor?: Floor };
  hidden: Box[];
}

export const crops = ({ crop, hidden }: Cropping): boolean => Boolean(crop.box ?? crop.floor) || hidden.length > 0;

// Returns a test of whether a surfel with a given centre is shown.
export function keeper({ crop: { box, floor }, hidden }: Cropping): (center: Vec3) => boolean {
  const inside = (of: Box): ((x: Vec3) => boolean) => {
    const axes = axesOf(of.quat);
    return (x) => {
      const from = subtract(x, of.center);
      return axes.every((axis, k) => Math.abs(dot(axis, from)) <= of.half[k]);
    };
  };
  const [kept, taken] = [box && inside(box), hidden.map(inside)];
  return (x) => !(kept && !kept(x)) && !(floor && dot(floor.normal, x) < floor.offset) && !taken.some((in_) => in_(x));
}

// Tells which surfels are shown: 1 or 0 for each.
export function keptOf({ words, count, origin }: Surfels, cropping: Cropping): Uint8Array {
  const keeps = keeper(cropping);
  const kept = new Uint8Array(count);
  for (let i = 0, at = WORD.mean; i < count; i++, at += SURFEL_WORDS) {
    kept[i] = Number(keeps([words[at] + origin[0], words[at + 1] + origin[1], words[at + 2] + origin[2]]));
  }
  return kept;
}
