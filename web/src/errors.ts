// What stops the viewer, in words for a page of its own.
export class ViewerError extends Error {
  constructor(
    readonly title: string,
    detail: string,
    readonly advice: string,
  ) {
    super(detail);
  }
}

const COPY = 'Copy the bundle again from where it is whole, or export the scene again with ns-export bitymi-atlas.';

export class DamagedBundle extends ViewerError {
  constructor(detail: string) {
    super('This bundle is damaged', detail, COPY);
  }
}
