// The poster over the place of the canvas, until there is a picture of the surfels.
import { element } from './dom';

let ended = false;

export async function showPoster(poster: Blob | null): Promise<void> {
  if (!poster || ended) return;
  const image = element<HTMLImageElement>('poster');
  const address = (image.src = URL.createObjectURL(poster));
  try {
    await image.decode();
  } catch {
    ended = true; // it is no picture
  }
  URL.revokeObjectURL(address);
  if (ended) return;
  image.hidden = false;
  if (document.documentElement.dataset.state === 'loading') document.documentElement.dataset.state = 'poster';
}

// There is a picture of the surfels, or there will be none.
export function endPoster(): void {
  ended = true;
  element('poster').hidden = true;
}
