// Elements of index.html.
export function element<T extends HTMLElement = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`index.html has no element ${id}`);
  return found as T;
}

export const press = (button: HTMLElement, on: boolean): void => button.setAttribute('aria-pressed', String(on));
export const pressed = (button: HTMLElement): boolean => button.getAttribute('aria-pressed') === 'true';
