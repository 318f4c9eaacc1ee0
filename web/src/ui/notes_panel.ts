// Saved views and notes: their lists, and the markers of notes over the scene.
import { LONGEST_NAME, LONGEST_TEXT, MOST_NOTES, MOST_VIEWS, type Note, type Notes, cleared } from '../view/notes';
import { type View, moved } from '../view/pose';
import { length, subtract } from '../view/vector';
import { button, element, make, onClick, toggle } from './dom';
import { notify } from './pages';
import { type NotesFile, type Picker, type Stage, isFull, place } from './stage';

const BEHIND = 0.97; // share of a note's depth; nearer surfels hide it

type Entry = Notes['views'][number] | Note;

export class NotesPanel {
  private editing: Entry | null = null;
  private readonly markers = new Map<Note, HTMLElement>();

  constructor(
    private readonly stage: Stage,
    private readonly picker: Picker,
    private readonly file: NotesFile,
  ) {
    onClick('save-view', () => this.addView());
    element('view-name').addEventListener('keydown', ({ key }) => {
      if (key === 'Enter') this.addView();
    });
    onClick('add-note', () => this.add());
    onClick('show-notes', () => {
      element('markers').hidden = !toggle('show-notes');
    });
    this.show();
  }

  private get all(): Notes {
    return this.file.all;
  }

  get names(): string[] {
    return this.all.views.map(({ name }) => name);
  }

  // Returns whether there is a view of that name.
  goTo(name: string): boolean {
    const named = this.all.views.find((view) => view.name === name);
    if (named) this.stage.fly(named.viewpoint);
    return named !== undefined;
  }

  // `still`: also finds which markers are hidden by surfels.
  async drawn(view: View, still: boolean): Promise<void> {
    const seen: { marker: HTMLElement; x: number; y: number; z: number }[] = [];
    for (const [{ position }, marker] of this.markers) {
      const at = place(marker, view, position);
      if (!at) continue;
      const [x, y, z] = [at[0] / view.width, at[1] / view.height, at[2]];
      marker.classList.toggle('left', x > 0.55);
      if (!still) marker.classList.remove('behind');
      seen.push({ marker, x, y, z });
    }
    if (!still || !seen.length || element('markers').hidden) return;
    const map = await this.stage.depths(view.scaledTo(Math.ceil(view.width / 4), Math.ceil(view.height / 4)));
    for (const { marker, x, y, z } of seen) {
      const nearest = map.depth[Math.floor(y * map.height) * map.width + Math.floor(x * map.width)];
      marker.classList.toggle('behind', nearest < BEHIND * z);
    }
  }

  private changed(): void {
    this.file.changed();
    this.show();
  }

  private addView(): void {
    const { views } = this.all;
    const field = element<HTMLInputElement>('view-name');
    let number = views.length + 1;
    while (this.names.includes(`View ${number}`)) number++;
    const name = cleared(field.value).trim() || `View ${number}`;
    const { pose, lens, target } = this.stage.shared();
    const there = views.find((view) => view.name === name);
    if (there) there.viewpoint = { pose, lens, target };
    else if (!isFull(views, MOST_VIEWS, 'views')) views.push({ name, viewpoint: { pose, lens, target } });
    field.value = '';
    this.changed();
  }

  private add(): void {
    if (isFull(this.all.notes, MOST_NOTES, 'notes')) return;
    this.picker.toggle('add-note', (position) => {
      this.editing = { text: '', position };
      this.all.notes.push(this.editing);
      this.show();
    });
  }

  private goToNote({ position }: Note): void {
    const { pose, lens, target } = this.stage.shared();
    const away = length(subtract(target, pose.position));
    this.stage.fly({ pose: moved({ ...pose, position }, 0, 0, -away), lens, target: position });
  }

  private show(): void {
    const { views, notes } = this.all;
    const viewRows = views.map((view) => this.row(views, view, view.name, () => this.stage.fly(view.viewpoint)));
    const noteRows = notes.map((note) => this.row(notes, note, note.text, () => this.goToNote(note)));
    element('view-rows').replaceChildren(...viewRows);
    element('note-rows').replaceChildren(...noteRows);
    this.markers.clear();
    for (const note of notes) {
      this.markers.set(note, make('div', { className: 'marker' }, make('span', { textContent: note.text })));
    }
    element('note-markers').replaceChildren(...this.markers.values());
    void this.drawn(this.stage.view(), true);
    document.querySelector<HTMLElement>('#notes-panel li :is(input, textarea)')?.focus();
  }

  private row<T extends Entry>(list: T[], entry: T, text: string, go: () => void): HTMLElement {
    if (this.editing === entry) return make('li', {}, this.field(list, entry, text));
    const edit = (): void => {
      this.editing = entry;
      this.show();
    };
    const remove = (): void => {
      list.splice(list.indexOf(entry), 1);
      this.changed();
    };
    return make(
      'li',
      {},
      button(text, { className: 'name', title: `Go to ${text}`, run: go }),
      button('✎', { ariaLabel: `Edit ${text}`, title: 'Edit', run: edit }),
      button('×', { ariaLabel: `Remove ${text}`, title: 'Remove', run: remove }),
    );
  }

  // Text field for the name of a view or the text of a note: Enter saves, Escape restores.
  private field<T extends Entry>(list: T[], entry: T, before: string): HTMLElement {
    const isNote = 'text' in entry;
    const common = { value: before, maxLength: isNote ? LONGEST_TEXT : LONGEST_NAME, className: 'name' };
    const field = isNote
      ? make('textarea', { ...common, rows: 3, ariaLabel: 'Text of the note' })
      : make('input', { ...common, type: 'text', ariaLabel: 'Name of the view' });
    const end = (text: string): void => {
      if (this.editing !== entry) return; // the field was removed and loses focus
      this.editing = null;
      const taken = !isNote && text !== before && this.names.includes(text);
      if (taken) notify(`Another view has the name ${text}.`);
      const kept = taken ? before : text || before;
      if (isNote) entry.text = kept;
      else entry.name = kept;
      if (!kept) list.splice(list.indexOf(entry), 1);
      if (kept !== before) this.changed();
      else this.show();
    };
    field.onblur = () => end(cleared(field.value).trim());
    field.onkeydown = (e) => {
      if ((e as KeyboardEvent).key === 'Escape') end(before);
      else if ((e as KeyboardEvent).key === 'Enter' && !(e as KeyboardEvent).shiftKey) field.blur();
    };
    return field;
  }
}
