// Pages in place of the scene: progress, poster, error.
import { type ViewerError, reasonOf } from '../errors';
import { element } from './dom';

const megabytes = (bytes: number): string => (bytes / 1e6).toFixed(1);

export function showProgress(done: number, total: number): void {
  if (stopped()) return;
  element<HTMLProgressElement>('page-progress').value = total ? done / total : 0;
  element('page-text').textContent = `${megabytes(done)} of ${megabytes(total)} MB`;
}

export const stopped = (): boolean => ['error', 'picture'].includes(document.documentElement.dataset.state ?? '');

let told: (title: string, message: string) => void = () => undefined;
export const onError = (tell: typeof told): void => void (told = tell);

// Shows the first error only, as later ones mostly follow from it.
export function showError(error: unknown): void {
  if (stopped()) return;
  const { title, message, advice } = reasonOf(error);
  element('page-title').textContent = title;
  element('page-text').textContent = message;
  element('page-advice').textContent = advice;
  element('page-progress').hidden = true;
  const parts = ['top', 'panel', 'menu', 'aside', 'notes-panel', 'measure-panel', 'crop-panel', 'markers'];
  for (const id of parts) element(id).hidden = true;
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

// Returns false if it is no picture.
async function showPicture(picture: Blob, unless = (): boolean => false): Promise<boolean> {
  const image = element<HTMLImageElement>('poster');
  const address = (image.src = URL.createObjectURL(picture));
  const decoded = await image.decode().then(
    () => true,
    () => false,
  );
  URL.revokeObjectURL(address);
  if (!decoded || unless()) return false;
  image.hidden = false;
  return true;
}

// Shows the first of these pictures that is one, with a line, instead of the error.
export async function showInstead(error: ViewerError, pictures: (Blob | null)[], title: string): Promise<void> {
  for (const picture of pictures) {
    if (!picture || !(await showPicture(picture, stopped))) continue;
    document.title = element<HTMLImageElement>('poster').alt = title;
    element('page-title').textContent = 'No WebGPU here: this is a picture';
    element('page-text').hidden = element('page-progress').hidden = true;
    document.documentElement.dataset.state = 'picture';
    told(error.title, error.message);
    return;
  }
  showError(error);
}

// The poster covers the canvas until the first frame.
let posterEnded = false;

export async function showPoster(poster: Blob | null): Promise<void> {
  if (!poster || posterEnded || !(await showPicture(poster, () => posterEnded))) return;
  if (document.documentElement.dataset.state === 'loading') document.documentElement.dataset.state = 'poster';
}

// Removes the poster: there is a first frame, or none will come.
export function endPoster(): void {
  posterEnded = true;
  element('poster').hidden = true;
}
