// The contents of notes.json: what was changed, and its download.
import { type Notes, notesText } from '../view/notes';
import { download } from './dom';

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
