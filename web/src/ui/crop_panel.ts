// Crop of the scene by a box and a floor, and boxes around floaters that are hidden.
import type { Vec3 } from '../bundle/manifest';
import type { Surfels } from '../bundle/surfels';
import type { extentOf } from '../view/cameras';
import { type Box, type Cropping, crops, keptOf } from '../view/crop';
import { MOST_HIDDEN } from '../view/notes';
import type { View } from '../view/pose';
import { axesOf, exponential, product, uprightQuat } from '../view/rotation';
import { add, dot, subtract, times } from '../view/vector';
import { button, element, make, onClick, press, pressed, toggle, writing } from './dom';
import { Lines, type NotesFile, type Picker, type Stage, edgesOf, isFull } from './stage';

type Mode = 'box' | 'floor' | 'hide';
const MODES: Mode[] = ['box', 'floor', 'hide'];
const AXES = ['Across', 'Along', 'Upwards'];
const STEPS = 400; // of a slider
const REACH = 2; // of the sliders of a crop, in sizes of the scene
const FLOATER = 0.05; // half side of a new box around a floater
const BELOW = 0.01; // distance of a new floor below the clicked point
const THINNEST = 1e-4; // half side of a box; all in sizes of the scene

export class CropPanel {
  private mode: Mode | null = null;
  private selected: Box | null = null; // around a floater
  private anchor: Vec3; // zero of the sliders
  private turned = 0; // degrees, by the slider
  private before: Cropping;
  private readonly undone: Cropping[] = [];
  private readonly lines = new Lines('box');
  private waiting = false;

  constructor(
    private readonly stage: Stage,
    private readonly picker: Picker,
    private readonly file: NotesFile,
    private readonly surfels: Surfels,
    private readonly extent: ReturnType<typeof extentOf> & { up: Vec3 },
  ) {
    this.anchor = extent.middle;
    this.before = this.copy();
    for (const mode of MODES) onClick(`crop-${mode}`, () => this.choose(this.mode === mode ? null : mode));
    onClick('hide-selected', () => this.hideSelected());
    onClick('remove-crop', () => this.remove());
    onClick('undo', () => this.undo());
    onClick('reset-crop', () => {
      Object.assign(this.all, { crop: {}, hidden: [] });
      this.changed();
    });
    onClick('apply-crop', () => {
      toggle('apply-crop');
      this.apply();
    });
    addEventListener('keydown', (e) => {
      if (e.key !== 'z' || !(e.ctrlKey || e.metaKey) || element('crop-panel').hidden || writing(e.target)) return;
      e.preventDefault();
      this.undo();
    });
    this.makeSliders();
    this.show();
    if (crops(this.all)) this.apply();
  }

  drawn(view: View): void {
    const box = element('crop-panel').hidden ? null : this.box;
    this.lines.draw(view, box ? edgesOf(box) : []);
  }

  private get all(): Cropping {
    return this.file.all;
  }

  private copy(): Cropping {
    return structuredClone({ crop: this.all.crop, hidden: this.all.hidden });
  }

  // The box that the sliders change.
  private get box(): Box | null {
    return this.mode === 'box' ? (this.all.crop.box ?? null) : this.mode === 'hide' ? this.selected : null;
  }

  private get reach(): number {
    return this.extent.size * (this.mode === 'hide' ? 10 * FLOATER : REACH);
  }

  private boxAt(center: Vec3, half: number): Box {
    return { center, half: [half, half, half], quat: uprightQuat(this.extent.up) };
  }

  // Chooses what the sliders change, null: nothing.
  choose(mode: Mode | null): void {
    const { middle, size, up } = this.extent;
    this.picker.stop();
    this.mode = mode;
    this.selected = null;
    this.anchor = middle;
    if (mode === 'box' && !this.all.crop.box) {
      this.all.crop.box = this.boxAt(middle, size);
      this.changed();
    } else if (mode === 'floor') {
      this.wait((point) => {
        this.all.crop.floor = { normal: up, offset: dot(up, point) - BELOW * size };
        this.changed();
      });
    } else if (mode === 'hide') {
      this.wait((point) => {
        this.anchor = point;
        this.selected = this.boxAt(point, FLOATER * size);
        this.show();
      });
    }
    this.show();
  }

  // Waits for clicks on surfaces, until something else is chosen.
  private wait(run: (point: Vec3) => void): void {
    this.picker.start(`crop-${this.mode}`, (point) => {
      run(point);
      this.wait(run);
    });
  }

  private hideSelected(): void {
    if (!this.selected || isFull(this.all.hidden, MOST_HIDDEN, 'hidden boxes')) return;
    this.all.hidden.push(this.selected);
    this.changed();
    this.choose('hide');
  }

  private remove(): void {
    if (this.mode === 'floor') delete this.all.crop.floor;
    else delete this.all.crop.box;
    this.mode = null;
    this.picker.stop();
    this.changed();
  }

  private undo(): void {
    const last = this.undone.pop();
    if (!last) return;
    Object.assign(this.all, last);
    this.settle();
  }

  // Keeps a finished change, and the state before it for undo.
  private changed(): void {
    this.undone.push(this.before);
    this.settle();
  }

  private settle(): void {
    this.before = this.copy();
    this.file.changed();
    this.show();
    this.apply();
  }

  private apply(): void {
    const applied = pressed(element('apply-crop')) && crops(this.all);
    this.stage.hide(applied ? keptOf(this.surfels, this.all) : null);
  }

  // Applies a change while a slider moves, once per frame.
  private applySoon(): void {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      if (this.mode !== 'hide') this.apply();
      this.drawn(this.stage.view());
    });
  }

  private makeSliders(): void {
    const slider = (label: string, move: (value: number) => void): HTMLInputElement => {
      const made = make('input', { type: 'range', min: '-1', max: '1', step: `${2 / STEPS}`, ariaLabel: label });
      made.oninput = () => {
        move(made.valueAsNumber);
        this.applySoon();
      };
      made.onchange = () => {
        if (this.mode !== 'hide') this.changed(); // the box around a floater is not kept before it is hidden
      };
      return made;
    };
    const rows = AXES.map((name, axis) =>
      make(
        'div',
        { className: 'slider' },
        make('span', { textContent: name }),
        slider(`${name}, from`, (value) => this.moveFace(axis, 0, value)),
        slider(`${name}, to`, (value) => this.moveFace(axis, 1, value)),
      ),
    );
    const turn = slider('Turn, degrees', (value) => this.turn(value));
    Object.assign(turn, { id: 'turn', min: '-90', max: '90', step: '0.5' });
    rows.push(make('div', { className: 'slider' }, make('span', { textContent: 'Turn' }), turn));
    element('faces').append(...rows);
    const height = slider('Height of the floor', (value) => this.moveFloor(value));
    height.id = 'height';
    element('floor-row').append(height);
  }

  // Ends of a box along its axes, from the anchor.
  private facesOf({ center, half, quat }: Box): [number, number][] {
    const from = subtract(center, this.anchor);
    return axesOf(quat).map((axis, k) => [dot(axis, from) - half[k], dot(axis, from) + half[k]]);
  }

  private moveFace(axis: number, end: 0 | 1, value: number): void {
    const { box } = this;
    if (!box) return;
    const [low, high] = this.facesOf(box)[axis];
    const thinnest = 2 * THINNEST * this.extent.size;
    const at = value * this.reach;
    const [from, to] = end ? [low, Math.max(at, low + thinnest)] : [Math.min(at, high - thinnest), high];
    box.center = add(box.center, times((from + to - low - high) / 2, axesOf(box.quat)[axis]));
    box.half[axis] = (to - from) / 2;
  }

  private turn(degrees: number): void {
    if (!this.box) return;
    const by = ((degrees - this.turned) * Math.PI) / 180;
    const quat = product(this.box.quat, exponential([0, 0, by / 2]));
    this.box.quat = quat.map((x) => x / Math.hypot(...quat)) as typeof quat;
    this.turned = degrees;
  }

  private moveFloor(value: number): void {
    const { floor } = this.all.crop;
    if (floor) floor.offset = dot(floor.normal, this.extent.middle) + value * this.reach;
  }

  private show(): void {
    const { crop, hidden } = this.all;
    if (this.mode === 'box' && !crop.box) this.mode = null; // undone
    for (const mode of MODES) press(element(`crop-${mode}`), this.mode === mode);
    element('faces').hidden = !this.box;
    element('floor-row').hidden = this.mode !== 'floor' || !crop.floor;
    element('hide-selected').hidden = !this.selected;
    element('remove-crop').hidden = !(this.mode === 'box' && crop.box) && !(this.mode === 'floor' && crop.floor);
    element('crop-hint').textContent = {
      box: 'Surfels outside of the box are hidden.',
      floor: crop.floor ? 'Surfels below are hidden. Click the ground, or move the slider.' : 'Click the ground.',
      hide: this.selected ? 'Fit the box around it.' : 'Click a floater.',
      none: 'Hidden surfels stay in the bundle.',
    }[this.mode ?? 'none'];
    this.turned = 0;
    element<HTMLInputElement>('turn').valueAsNumber = 0;
    const sliders = [...document.querySelectorAll<HTMLInputElement>('#faces input')];
    if (this.box) {
      const ends = this.facesOf(this.box).flat();
      ends.forEach((end, k) => (sliders[k].valueAsNumber = end / this.reach));
    }
    if (crop.floor) {
      const height = crop.floor.offset - dot(crop.floor.normal, this.extent.middle);
      element<HTMLInputElement>('height').valueAsNumber = height / this.reach;
    }
    const rows = hidden.map((box, k) => {
      const remove = (): void => {
        hidden.splice(hidden.indexOf(box), 1);
        this.changed();
      };
      const name = `Hidden box ${k + 1}`;
      return make(
        'li',
        {},
        make('span', { className: 'name', textContent: name }),
        button('×', { title: `Show ${name}`, run: remove }),
      );
    });
    element('hidden-rows').replaceChildren(...rows);
    element<HTMLButtonElement>('undo').disabled = !this.undone.length;
    element<HTMLButtonElement>('reset-crop').disabled = !crops(this.all);
    element('apply-crop').hidden = !crops(this.all);
    this.drawn(this.stage.view());
  }
}
