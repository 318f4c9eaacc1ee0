// The page: loads the bundle beside it and shows it.
import './ui/style.css';
import './ui/notes.css';
import { App } from './app';
import { type Bundle, loadBundle, loadManifest } from './bundle/load';
import { loadPoster, loadPreview } from './bundle/poster';
import { BESIDE, Folder, SingleFile, type Source } from './bundle/source';
import { Embed } from './embed';
import { NoGraphics, ViewerError, messageOf } from './errors';
import { type Graphics, openDevice, watch } from './render/device';
import { checkRoom } from './render/limits';
import { Programs } from './render/programs';
import { Renderer } from './render/renderer';
import { SceneOnDevice } from './render/scene';
import { screenOf } from './render/screen';
import { element } from './ui/dom';
import { notify, onError, showError, showInstead, showPoster, showProgress, showScene } from './ui/pages';
import { type Notes, noNotes, parseNotes } from './view/notes';
import { fromHash } from './view/share';

// Opens the bundle beside the page: the file in the address (?file=), the one named by an export, or a folder.
async function source(): Promise<Source> {
  const asked = new URLSearchParams(location.search).get('file');
  const file = asked ?? document.querySelector<HTMLMetaElement>('meta[name=bundle]')?.content ?? '';
  if (!file) return new Folder('bundle/');
  if (!BESIDE.test(file)) {
    const what = 'It must lie beside the page, and have letters, digits, dots and dashes before .bitymi.';
    throw new ViewerError('This is not the name of a bundle in one file', what, 'Change the address.');
  }
  return SingleFile.open(file, showProgress);
}

// Reads view.json, written by the server or an export.
async function about(): Promise<{ title: string; notes: boolean }> {
  const file = new URLSearchParams(location.search).get('file');
  if (file) return { title: file.replace(/\.bitymi$/, ''), notes: false };
  try {
    const { title, notes } = (await (await fetch('view.json')).json()) as { title?: unknown; notes?: unknown };
    return { title: typeof title === 'string' ? title.slice(0, 120) : 'Scene', notes: notes === true };
  } catch {
    return { title: 'Scene', notes: false };
  }
}

// An invalid notes.json is ignored.
async function notesOf(from: Source, stated: boolean): Promise<Notes> {
  try {
    const text = await from.notes(stated);
    if (text !== null) return parseNotes(text);
  } catch (error) {
    notify(`notes.json cannot be used: ${messageOf(error)}`);
  }
  return noNotes();
}

// Loads the bundle, after the poster if that shows the first view.
async function load(opened: Promise<Source>, opening: Promise<Graphics>): Promise<Bundle> {
  const from = await opened;
  const info = await loadManifest(from);
  opening.catch(async (error: unknown) => {
    if (!(error instanceof NoGraphics)) return;
    const pictures = [await loadPreview(from, info), await loadPoster(from, info)];
    await showInstead(error, pictures, (await about()).title);
  });
  await Promise.race([opening, null]); // where nothing can draw, nothing of the scene is fetched
  if (!fromHash(location.hash)) void loadPoster(from, info).then(showPoster);
  const admit = async (): Promise<void> => {
    const { deviceMemory } = navigator as { deviceMemory?: number }; // not in all browsers
    checkRoom(info, (await opening).device.limits, deviceMemory);
  };
  return loadBundle(from, info, showProgress, admit, notify);
}

const unlessPicture = (error: unknown): void => {
  if (!(error instanceof NoGraphics)) showError(error);
};

async function main(): Promise<void> {
  const opening = openDevice();
  const opened = source();
  const loading = load(opened, opening);
  loading.catch(unlessPicture);
  const graphics = await opening;
  const { device } = graphics;
  watch(device, showError);
  const programs = new Programs(device);
  const bundle = await loading;
  const scene = new SceneOnDevice(graphics, programs, bundle.info, bundle.surfels, bundle.pages);
  const canvas = element<HTMLCanvasElement>('canvas');
  if (graphics.software) notify('No graphics card draws here: the processor does, slowly.');
  if (scene.decoded) {
    notify('This device draws no BC7 textures: the texture was decoded, at four times the graphics memory.');
  }
  const { title, notes: stated } = await about();
  document.title = element('title').textContent = title;
  const notes = await notesOf(await opened, stated);
  showScene();
  const renderer = new Renderer(graphics, programs, scene);
  const app = new App(canvas, screenOf(canvas, renderer, graphics), renderer, bundle, notes, () => embed.shown());
  app.start();
  embed.ready(app, document.title);
  if (bundle.later) {
    scene.setTexels(await bundle.later());
    app.changed();
  }
}

const embed = new Embed();
onError((title, message) => embed.failed(title, message));
document.documentElement.dataset.state = 'loading';
element('page-late').hidden = true;
addEventListener('unhandledrejection', ({ reason }) => showError(reason));
addEventListener('error', ({ error }) => error && showError(error)); // browser notices have no error
main().catch(unlessPicture);
