// An error that stops the viewer, with the texts of its page.
export class ViewerError extends Error {
  constructor(
    readonly title: string,
    detail: string,
    readonly advice: string,
  ) {
    super(detail);
  }
}

// Nothing here can draw: the page shows a picture, if the bundle has one.
export class NoGraphics extends ViewerError {}

// Memory of the device or the browser is exceeded.
export const tooLarge = (detail: string): ViewerError =>
  new ViewerError('This scene is too large for this device', detail, 'Open it on a device with more memory.');

export const messageOf = (error: unknown): string => (error instanceof Error ? error.message : String(error));

// Explains any error; a RangeError of a too large array is a lack of memory.
export function reasonOf(error: unknown): ViewerError {
  if (error instanceof ViewerError) return error;
  if (error instanceof RangeError) return tooLarge('There is not enough memory for it.');
  return new ViewerError('The viewer stopped', messageOf(error), 'Reload the page to try again.');
}

const COPY = 'Copy the bundle again from where it is whole, or export the scene again with ns-export bitymi-atlas.';

export class DamagedBundle extends ViewerError {
  constructor(detail: string) {
    super('This bundle is damaged', detail, COPY);
  }
}
