// Elements of index.html.
export function element<T extends HTMLElement = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`index.html has no element ${id}`);
  return found as T;
}

export const press = (button: HTMLElement, on: boolean): void => button.setAttribute('aria-pressed', String(on));
export const pressed = (button: HTMLElement): boolean => button.getAttribute('aria-pressed') === 'true';

// Returns whether the button is pressed then.
export function toggle(id: string): boolean {
  press(element(id), !pressed(element(id)));
  return pressed(element(id));
}

export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]>,
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

export const onClick = (id: string, run: () => void): void => element(id).addEventListener('click', run);

// ariaLabel: name for screen readers, if the text is a symbol.
export const button = (
  text: string,
  { run, ...properties }: { title: string; run: () => void; className?: string; ariaLabel?: string },
): HTMLButtonElement => make('button', { type: 'button', onclick: run, ...properties }, text);

// Returns true if keys go to an element instead of the scene.
export const typing = (target: EventTarget | null): boolean =>
  [HTMLSelectElement, HTMLInputElement, HTMLTextAreaElement].some((kind) => target instanceof kind);

// As `typing`, but not for sliders, which take the arrows alone.
export const writing = (target: EventTarget | null): boolean =>
  typing(target) && !(target instanceof HTMLInputElement && target.type === 'range');

export function download(name: string, data: Blob): void {
  const link = make('a', { href: URL.createObjectURL(data), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
