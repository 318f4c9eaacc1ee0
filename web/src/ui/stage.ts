// What the panels share: the viewer, clicks on surfaces, lines and marks over the scene, and notes.json.
import type { Vec3 } from '../bundle/manifest';
import type { Depths } from '../render/renderer';
import type { Box } from '../view/crop';
import { type Notes, notesText } from '../view/notes';
import { View, moved } from '../view/pose';
import { axesOf } from '../view/rotation';
import type { Shared, Viewpoint } from '../view/share';
import { add, times } from '../view/vector';
import { download, element, press, pressed } from './dom';
import { notify } from './pages';

// Interface of the viewer to its panels.
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

// Returns true, and says so, if a list has no room for another entry.
export function isFull(list: unknown[], most: number, what: string): boolean {
  if (list.length >= most) notify(`There are ${most} ${what}, as many as there can be.`);
  return list.length >= most;
}

// Moves a mark to a point of the scene, and hides it outside the picture; returns View.project.
export function place(mark: HTMLElement, view: View, point: Vec3): Vec3 | null {
  const at = view.project(point);
  mark.hidden = !at;
  if (at) Object.assign(mark.style, { left: `${(100 * at[0]) / view.width}%`, top: `${(100 * at[1]) / view.height}%` });
  return at;
}

const STILL_HAND = 5; // pixels of pointer movement that still count as a click
const STILL_FINGER = 15;

export class Picker {
  private pressedAt: [number, number] | null = null; // null: with several fingers
  private wanted: { button: string; run: (point: Vec3) => void } | null = null;

  constructor(
    private readonly stage: Stage,
    private readonly canvas: HTMLCanvasElement,
  ) {
    canvas.addEventListener('pointerdown', ({ isPrimary, button, clientX, clientY }) => {
      this.pressedAt = isPrimary && button === 0 ? [clientX, clientY] : null;
    });
    // not `click`, which a long touch does not fire
    canvas.addEventListener('pointerup', ({ clientX, clientY, pointerType }) => {
      const { wanted, pressedAt } = this;
      this.pressedAt = null;
      if (!wanted || !pressedAt) return;
      const apart = Math.hypot(clientX - pressedAt[0], clientY - pressedAt[1]);
      if (apart >= (pointerType === 'touch' ? STILL_FINGER : STILL_HAND)) return;
      void this.surface(clientX, clientY).then((point) => {
        if (wanted !== this.wanted) return; // an earlier click was taken
        if (!point) {
          notify('There is no surface at that pixel: click another.');
          return;
        }
        this.stop();
        wanted.run(point);
      });
    });
  }

  get waits(): boolean {
    return this.wanted !== null;
  }

  // Waits for a click on a surface, while a button stays pressed.
  start(button: string, run: (point: Vec3) => void): void {
    this.stop();
    this.wanted = { button, run };
    press(element(button), true);
    this.canvas.classList.add('placing');
  }

  stop(): void {
    if (this.wanted) press(element(this.wanted.button), false);
    this.wanted = null;
    this.canvas.classList.remove('placing');
  }

  toggle(button: string, run: (point: Vec3) => void): void {
    if (pressed(element(button))) this.stop();
    else this.start(button, run);
  }

  // Finds the surface seen through a screen pixel.
  async surface(clientX: number, clientY: number): Promise<Vec3 | null> {
    const [view, box] = [this.stage.view(), this.canvas.getBoundingClientRect()];
    const x = ((clientX - box.left) / box.width) * view.width;
    const y = ((clientY - box.top) / box.height) * view.height;
    const pixel = new View(view.pose, view.fx, view.fy, view.cx - x + 0.5, view.cy - y + 0.5, 1, 1);
    const [depth] = (await this.stage.depths(pixel)).depth;
    if (!Number.isFinite(depth)) return null;
    const [right, down] = [((x - view.cx) / view.fx) * depth, ((y - view.cy) / view.fy) * depth];
    return moved(view.pose, right, down, depth).position;
  }
}

export type Line = [Vec3, Vec3];

const SVG = 'http://www.w3.org/2000/svg';

export class Lines {
  private readonly path = document.createElementNS(SVG, 'path');

  constructor(style: string) {
    this.path.setAttribute('class', style);
    element('lines').append(this.path);
  }

  draw(view: View, lines: Line[]): void {
    const parts = lines.map(([a, b]) => view.segment(a, b)).filter((part) => part !== null);
    this.path.setAttribute('d', parts.map(([x, y, u, v]) => `M${x} ${y}L${u} ${v}`).join(''));
    this.path.ownerSVGElement?.setAttribute('viewBox', `0 0 ${view.width} ${view.height}`);
  }
}

export function edgesOf({ center, half, quat }: Box): Line[] {
  const sides = axesOf(quat).map((axis, k) => times(half[k], axis));
  const corner = (k: number): Vec3 =>
    sides.reduce((at, side, axis) => add(at, times(k & (1 << axis) ? 1 : -1, side)), center);
  const from = (axis: number): number[] => [0, 1, 2, 3, 4, 5, 6, 7].filter((k) => !(k & (1 << axis)));
  return [0, 1, 2].flatMap((axis) => from(axis).map((k): Line => [corner(k), corner(k | (1 << axis))]));
}

// The contents of notes.json: what was changed, and its download.
export class NotesFile {
  private saved = true;
  private readonly buttons = document.querySelectorAll<HTMLButtonElement>('.save-notes');

  constructor(readonly all: Notes) {
    for (const button of this.buttons) {
      button.onclick = () => {
        download('notes.json', new Blob([notesText(all)], { type: 'application/json' }));
        this.saved = true;
        this.show();
      };
    }
    addEventListener('beforeunload', (e) => {
      if (!this.saved) e.preventDefault();
    });
    this.show();
  }

  changed(): void {
    this.saved = false;
    this.show();
  }

  private show(): void {
    const { views, notes, measures, unit, crop, hidden } = this.all;
    const empty = ![...views, ...notes, ...measures, ...hidden].length && !unit && !crop.box && !crop.floor;
    for (const button of this.buttons) {
      button.disabled = empty && this.saved;
      button.classList.toggle('unsaved', !this.saved);
    }
  }
}
