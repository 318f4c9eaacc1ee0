// Measures: distances between points on surfaces, and the unit in which they are shown.
import type { Vec3 } from '../bundle/manifest';
import { LONGEST_NAME, LONGEST_UNIT, MOST_MEASURES, type Measure, type Unit, cleared } from '../view/notes';
import type { View } from '../view/pose';
import { add, length, subtract, times } from '../view/vector';
import { button, element, make, onClick, pressed, writing } from './dom';
import { notify } from './pages';
import { type Line, Lines, type NotesFile, type Picker, type Stage, isFull, place } from './stage';

const UNKNOWN: Unit = { name: 'units', perWorld: 1 };
const DIGITS = 4;
const COARSE = 'This device measures depths to three digits.'; // of half floats

export const distance = ({ points: [a, b] }: Measure): number => length(subtract(a, b));

export function lengthText(world: number, { name, perWorld }: Unit): string {
  const shown = Number((world * perWorld).toPrecision(DIGITS));
  return `${shown.toLocaleString('en', { maximumSignificantDigits: DIGITS, useGrouping: false })} ${name}`;
}

export class MeasurePanel {
  private first: Vec3 | null = null; // of a measure whose second point is awaited
  private chosen: Measure | null = null; // whose length may be stated
  private readonly labels = new Map<Measure, HTMLElement>();
  private readonly lines = new Lines('measures');
  private readonly ends = new Lines('ends');

  constructor(
    private readonly stage: Stage,
    private readonly picker: Picker,
    private readonly file: NotesFile,
    private readonly metres: number | null, // per unit of the scene
  ) {
    onClick('add-measure', () => this.toggle());
    onClick('set-unit', () => this.setUnit());
    element('known-row').addEventListener('keydown', (e) => {
      if (e.key === 'Enter' && writing(e.target)) this.setUnit();
    });
    onClick('reset-unit', () => {
      this.file.all.unit = null;
      this.changed();
    });
    this.chosen = file.all.measures.at(-1) ?? null;
    this.show();
  }

  drawn(view: View): void {
    const { measures } = this.file.all;
    const dots = measures.flatMap(({ points }): Vec3[] => points);
    const waits = pressed(element('add-measure'));
    if (this.first && waits) dots.push(this.first);
    const click = waits ? [`Click the ${this.first ? 'other' : 'first'} surface.`] : [];
    element('measure-hint').textContent = [...click, ...(this.stage.coarse ? [COARSE] : [])].join(' ');
    const [between, ends] = [measures.map(({ points }): Line => points), dots.map((at): Line => [at, at])];
    this.lines.draw(view, between);
    this.ends.draw(view, ends);
    for (const [{ points }, label] of this.labels) place(label, view, times(0.5, add(...points)));
  }

  private get unit(): Unit {
    return this.file.all.unit ?? (this.metres ? { name: 'm', perWorld: this.metres } : UNKNOWN);
  }

  private toggle(): void {
    this.first = null;
    if (isFull(this.file.all.measures, MOST_MEASURES, 'measures')) return;
    this.picker.toggle('add-measure', (from) => {
      this.first = from;
      this.picker.start('add-measure', (to) => {
        this.first = null;
        if (length(subtract(from, to))) {
          this.chosen = { points: [from, to], text: '' };
          this.file.all.measures.push(this.chosen);
          this.changed();
        } else this.redraw();
      });
      this.redraw();
    });
    this.redraw();
  }

  // By the stated length of the chosen measure.
  private setUnit(): void {
    const known = element<HTMLInputElement>('known').valueAsNumber;
    const name = cleared(element<HTMLInputElement>('unit-name').value).trim() || 'm';
    if (!this.chosen || !(known > 0)) {
      notify('Choose a measure, and enter its length.');
      return;
    }
    const perWorld = known / distance(this.chosen);
    if (!(perWorld >= 1e-9 && perWorld <= 1e9)) {
      notify('That length is not possible.');
      return;
    }
    this.file.all.unit = { name: [...name].slice(0, LONGEST_UNIT).join(''), perWorld };
    element<HTMLInputElement>('known').value = '';
    this.changed();
  }

  private changed(): void {
    this.file.changed();
    this.show();
  }

  private redraw(): void {
    this.drawn(this.stage.view());
  }

  private show(): void {
    const { measures, unit } = this.file.all;
    element('measure-rows').replaceChildren(...measures.map((measure) => this.row(measure)));
    element('known-row').hidden = !measures.length;
    element('reset-unit').hidden = !unit;
    element<HTMLInputElement>('unit-name').value = this.unit === UNKNOWN ? 'm' : this.unit.name;
    for (const label of this.labels.values()) label.remove();
    this.labels.clear();
    for (const measure of measures) {
      const text = [measure.text, lengthText(distance(measure), this.unit)].filter(Boolean).join(': ');
      const label = make('div', { className: 'label' }, make('span', { textContent: text }));
      this.labels.set(measure, label);
    }
    element('labels').replaceChildren(...this.labels.values());
    this.redraw();
  }

  private row(measure: Measure): HTMLElement {
    const { measures } = this.file.all;
    const shown = lengthText(distance(measure), this.unit);
    const label = make('input', { type: 'text', className: 'name', value: measure.text, maxLength: LONGEST_NAME });
    Object.assign(label, { placeholder: 'Label', ariaLabel: `Label of the measure of ${shown}` });
    label.onchange = () => {
      measure.text = cleared(label.value).trim();
      this.changed();
    };
    const choose = button(shown, {
      title: 'Choose it, to state its length',
      run: () => {
        this.chosen = measure;
        this.show();
        element('known').focus();
      },
    });
    choose.setAttribute('aria-pressed', String(measure === this.chosen));
    const remove = (): void => {
      measures.splice(measures.indexOf(measure), 1);
      if (measure === this.chosen) this.chosen = measures.at(-1) ?? null;
      this.changed();
    };
    return make('li', {}, label, choose, button('×', { ariaLabel: `Remove ${shown}`, title: 'Remove', run: remove }));
  }
}
