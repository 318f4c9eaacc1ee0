// What stands in the place of the scene: progress, or why there is none.
import { ViewerError } from '../errors';
import { element } from './dom';
import { endPoster } from './poster';

const megabytes = (bytes: number): string => (bytes / 1e6).toFixed(1);

export function showProgress(done: number, total: number): void {
  if (document.documentElement.dataset.state === 'error') return;
  element<HTMLProgressElement>('page-progress').value = total ? done / total : 0;
  element('page-text').textContent = `${megabytes(done)} of ${megabytes(total)} MB`;
}

export function showError(error: unknown): void {
  const known = error instanceof ViewerError;
  const message = error instanceof Error ? error.message : String(error);
  element('page-title').textContent = known ? error.title : 'The viewer stopped';
  element('page-text').textContent = message;
  element('page-advice').textContent = known ? error.advice : 'Reload the page to try again.';
  element('page-progress').hidden = true;
  for (const id of ['top', 'panel', 'menu']) element(id).hidden = true;
  element('page').hidden = false;
  endPoster();
  document.documentElement.dataset.state = 'error';
}

export function showScene(): void {
  element('page').hidden = true;
  for (const id of ['top', 'panel', 'menu']) element(id).hidden = false;
  document.documentElement.dataset.state = 'ready';
}

export function notify(text: string): void {
  const notice = element('notice');
  notice.textContent = text;
  notice.hidden = false;
  setTimeout(() => (notice.hidden = true), 8000);
}
