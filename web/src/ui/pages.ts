// What stands in the place of the scene: progress, or why there is none.
import { reasonOf } from '../errors';
import { element } from './dom';
import { endPoster } from './poster';

const megabytes = (bytes: number): string => (bytes / 1e6).toFixed(1);

export function showProgress(done: number, total: number): void {
  if (stopped()) return;
  element<HTMLProgressElement>('page-progress').value = total ? done / total : 0;
  element('page-text').textContent = `${megabytes(done)} of ${megabytes(total)} MB`;
}

export const stopped = (): boolean => document.documentElement.dataset.state === 'error';

let told: (title: string, message: string) => void = () => undefined;
export const onError = (tell: typeof told): void => void (told = tell);

// The first error is the one that is shown: those that follow mostly follow from it.
export function showError(error: unknown): void {
  if (stopped()) return;
  const { title, message, advice } = reasonOf(error);
  element('page-title').textContent = title;
  element('page-text').textContent = message;
  element('page-advice').textContent = advice;
  element('page-progress').hidden = true;
  for (const id of ['top', 'panel', 'menu', 'aside', 'notes-panel', 'markers']) element(id).hidden = true;
  element('page').hidden = false;
  endPoster();
  document.documentElement.dataset.state = 'error';
  told(title, message);
}

export function showScene(): void {
  if (stopped()) return;
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
