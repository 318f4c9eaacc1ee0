// Opening and closing of panels, help and full screen; the theme.
import { element, onClick, press } from './dom';

// Side panels: button that opens it, button that closes it, section.
const ASIDES = [
  ['tools', 'close', 'aside'],
  ['notes', 'close-notes', 'notes-panel'],
  ['measure', 'close-measure', 'measure-panel'],
  ['crop', 'close-crop', 'crop-panel'],
] as const;

const onPhone = (): boolean => matchMedia('(width <= 720px)').matches; // style.css

const isOpen = (): boolean => element('panel').classList.contains('open');

// Opens or closes a panel; at most one side panel is open, on phones one panel of any kind.
function open(panel: 'panel' | (typeof ASIDES)[number][2], opened: boolean): void {
  const controls = panel === 'panel' ? opened : isOpen() && !(opened && onPhone());
  element('panel').classList.toggle('open', controls);
  element('menu').setAttribute('aria-expanded', String(controls));
  for (const [button, , aside] of ASIDES) {
    const stays = !element(aside).hidden && !(opened && (panel !== 'panel' || onPhone()));
    element(aside).hidden = panel === aside ? !opened : !stays;
    press(element(button), !element(aside).hidden);
  }
}

function turnTheme(): void {
  const root = document.documentElement;
  const next = { '': 'light', light: 'dark', dark: '' }[root.dataset.theme ?? ''] ?? '';
  if (next) root.dataset.theme = next;
  else delete root.dataset.theme;
  element('theme').textContent = next ? `Theme: ${next}` : 'Theme';
}

// Binds the buttons; `changed` is called when a panel has opened or closed.
export function bindPanels(canvas: HTMLElement, changed: () => void): void {
  open('panel', !onPhone());
  for (const button of ['menu', 'hide-panel']) onClick(button, () => open('panel', !isOpen()));
  for (const [button, close, aside] of ASIDES) {
    onClick(button, () => {
      open(aside, element(aside).hidden);
      changed();
    });
    onClick(close, () => {
      open(aside, false);
      canvas.focus();
      changed();
    });
  }
  onClick('theme', turnTheme);
  const help = element<HTMLDialogElement>('help');
  onClick('show-help', () => (help.open ? help.close() : help.showModal()));
  onClick('close-help', () => help.close());
  help.addEventListener('click', ({ target }) => {
    if (target === help) help.close(); // beside its contents
  });
  element('full-screen').hidden = !document.fullscreenEnabled;
  onClick('full-screen', () => {
    void (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  });
  document.addEventListener('fullscreenchange', () => {
    press(element('full-screen'), document.fullscreenElement !== null);
  });
}
