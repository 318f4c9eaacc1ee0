// The page: loads the bundle beside it and shows it.
import './ui/style.css';
import { App } from './app';
import { loadBundle } from './bundle/load';
import { openDevice } from './render/device';
import { Programs } from './render/programs';
import { Renderer } from './render/renderer';
import { SceneOnDevice } from './render/scene';
import { screenOf } from './render/screen';
import { element } from './ui/dom';
import { notify, showError, showProgress, showScene } from './ui/pages';

const BUNDLE = 'bundle/';

// The scene's name, which the service and an export write beside the page.
async function title(): Promise<string> {
  try {
    const found = (await (await fetch('view.json')).json()) as { title?: unknown };
    return typeof found.title === 'string' ? found.title.slice(0, 120) : 'Scene';
  } catch {
    return 'Scene';
  }
}

async function main(): Promise<void> {
  const graphics = await openDevice();
  const { device } = graphics;
  const loading = loadBundle(BUNDLE, showProgress);
  const programs = new Programs(device);
  const bundle = await loading;
  const scene = new SceneOnDevice(graphics, programs, bundle.info, bundle.surfels, bundle.pages);
  const canvas = element<HTMLCanvasElement>('canvas');
  void device.lost.then((lost) => {
    if (lost.reason !== 'destroyed') showError(new Error(`The graphics device was lost: ${lost.message}`));
  });
  document.title = element('title').textContent = await title();
  showScene();
  const renderer = new Renderer(graphics, programs, scene);
  const app = new App(canvas, screenOf(canvas, renderer, graphics), renderer, bundle);
  if (graphics.software) notify('No graphics card draws here: the processor does, slowly.');
  if (scene.decoded) {
    notify('This device draws no BC7 textures: the texture was decoded, at four times the graphics memory.');
  }
  app.start();
  if (bundle.later) {
    scene.setTexels(await bundle.later());
    app.changed();
  }
}

main().catch(showError);
