// The viewer: state, drawing on change, and its controls.
import type { Bundle } from './bundle/load';
import { reasonOf } from './errors';
import type { Vec3 } from './bundle/manifest';
import type { Depths, DrawOptions, Renderer } from './render/renderer';
import type { Show } from './render/programs';
import { Pace, type Screen } from './render/screen';
import { download, element, onClick, press, pressed, toggle, writing } from './ui/dom';
import { CropPanel } from './ui/crop_panel';
import { MeasurePanel } from './ui/measure_panel';
import { NotesPanel } from './ui/notes_panel';
import { endPoster, notify, showError, stopped } from './ui/pages';
import { bindPanels } from './ui/panels';
import { PathPanel } from './ui/path_panel';
import { NotesFile, Picker, type Stage } from './ui/stage';
import { type CaptureCamera, commonTarget, correctionAt, extentOf, firstPose, parseCameras } from './view/cameras';
import { Controls, type Mode } from './view/controls';
import type { Notes } from './view/notes';
import { Flight } from './view/path';
import { DEFAULT_LENS, type Lens, type Pose, View, moved } from './view/pose';
import { type Shared, type Viewpoint, fromHash, toHash } from './view/share';
import { length, subtract, unit } from './view/vector';

const MOVING_LAYERS = 4; // batches per frame while the camera moves, and at rest
const STILL_LAYERS = 16;
const STILL_AFTER = 250; // milliseconds

const KEYS: Record<string, string> = {
  ...{ o: 'orbit', f: 'fly', h: 'home', ',': 'previous', '.': 'next', p: 'beside', t: 'texture', c: 'colors' },
  ...{ i: 'exposure', l: 'share', n: 'tools', m: 'notes', k: 'add-keyframe', v: 'play' },
  ...{ r: 'measure', b: 'crop', g: 'full-screen', u: 'menu', '?': 'show-help' },
};

const unsaved = (): void => notify('This view cannot be saved: there is not enough memory for it.');

export class App implements Stage {
  private readonly controls: Controls;
  private readonly path: PathPanel;
  private readonly picker: Picker;
  readonly notes: NotesPanel;
  private readonly measures: MeasurePanel;
  private readonly crop: CropPanel;
  private readonly cameras: CaptureCamera[];
  private readonly pace = new Pace();
  private readonly size: number;
  private lens: Lens = DEFAULT_LENS;
  private first: Viewpoint;
  private held: Vec3 | null = null;
  private flight: Flight | null = null;
  private show: Show = 'color';
  private photograph: Promise<string> | null = null; // requested
  private dirty = true;
  private still = false;
  private movedAt = 0;
  private drawing = false;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly screen: Screen,
    private readonly renderer: Renderer,
    private readonly bundle: Bundle,
    notes: Notes,
    private readonly shown: () => void, // called after each frame
  ) {
    const { info, surfels } = bundle;
    const { middle, size } = extentOf(surfels);
    const up = info.up ?? [0, 0, 1];
    this.size = size;
    this.cameras = parseCameras(bundle.cameras ?? '');
    this.first = { pose: firstPose(middle, size, up), target: middle, lens: DEFAULT_LENS };
    if (this.cameras.length) {
      const start = this.cameras.find((camera) => camera.heldOut) ?? this.cameras[0];
      this.first = { pose: start.pose, target: this.targetOf(start.pose), lens: start.lens };
    }
    this.controls = new Controls(canvas, this.first.pose, this.first.target, up, size, () => {
      this.path.stop();
      this.flight = null;
      this.changed();
    });
    this.lens = this.first.lens;
    this.path = new PathPanel(this, canvas);
    this.picker = new Picker(this, canvas);
    const file = new NotesFile(notes);
    this.notes = new NotesPanel(this, this.picker, file);
    this.measures = new MeasurePanel(this, this.picker, file, info.metres);
    this.crop = new CropPanel(this, this.picker, file, surfels, { middle, size, up: unit(up) });
    this.bind();
  }

  start(): void {
    this.applyHash();
    new ResizeObserver(() => this.changed()).observe(this.canvas);
    addEventListener('hashchange', () => this.applyHash());
    this.canvas.focus();
    requestAnimationFrame((now) => this.tick(now));
  }

  private applyHash(): void {
    const shared = fromHash(location.hash);
    if (shared) this.apply(shared);
  }

  private targetOf(pose: Pose): Vec3 {
    const common = commonTarget(this.cameras);
    const ahead = common ? length(subtract(common, pose.position)) : this.size;
    return moved(pose, 0, 0, ahead).position;
  }

  shared(): Shared {
    const { pose, target } = this.controls;
    return { pose, target, lens: this.lens, show: this.show, residuals: pressed(element('texture')) };
  }

  go({ pose, lens, target }: Omit<Viewpoint, 'target'> & Partial<Viewpoint>): void {
    this.path.stop();
    this.flight = null;
    this.place(pose, lens, target);
  }

  fly(to: Viewpoint): void {
    if (matchMedia('(prefers-reduced-motion: reduce)').matches) {
      this.go(to);
      return;
    }
    this.path.stop();
    this.flight = new Flight(this.shared(), to);
    this.changed();
  }

  view(): View {
    return View.contain(this.controls.pose, this.lens, ...this.pixels());
  }

  hide(kept: Uint8Array | null): void {
    this.renderer.scene.hide(kept);
    this.changed();
  }

  // Makes the surface at a screen pixel the orbit centre.
  private async turnAround(clientX: number, clientY: number): Promise<void> {
    const target = this.picker.waits ? null : await this.picker.surface(clientX, clientY);
    if (!target) return;
    const { pose } = this.controls;
    const away = length(subtract(target, pose.position));
    this.fly({ pose: moved({ ...pose, position: target }, 0, 0, -away), lens: this.lens, target });
  }

  get coarse(): boolean {
    return this.renderer.coarse;
  }

  depths(view: View): Promise<Depths> {
    return this.renderer.depths(view, this.options(view.width === 1));
  }

  private place(pose: Pose, lens: Lens, target = this.targetOf(pose)): void {
    this.controls.pose = pose;
    this.controls.target = target;
    this.lens = lens;
    this.changed();
  }

  fileName(ending: string): string {
    return `${document.title || 'scene'}.${ending}`;
  }

  apply(shared: Shared): void {
    this.setShow(shared.show);
    press(element('texture'), shared.residuals);
    this.go(shared);
  }

  // Requests a new frame.
  changed(): void {
    this.dirty = true;
    this.still = false;
    this.movedAt = performance.now();
    document.documentElement.dataset.frame = 'moving';
  }

  private options(still: boolean): DrawOptions {
    return {
      show: this.show,
      residuals: pressed(element('texture')),
      held: this.held,
      background: this.bundle.info.background,
      correction: this.correction,
      layers: still ? STILL_LAYERS : MOVING_LAYERS,
      fine: still,
      farthest: length(subtract(this.controls.pose.position, this.first.target)) + 1.5 * this.size,
    };
  }

  // Of the photograph whose pose the camera has; none on a path, which may pass through such poses.
  private get correction(): number[] | null {
    const shows = this.show === 'color' && pressed(element('exposure')) && !this.path.plays;
    return shows ? correctionAt(this.cameras, this.controls.pose) : null;
  }

  private tick(now: number): void {
    if (stopped()) return;
    requestAnimationFrame((next) => this.tick(next));
    this.controls.advance(now);
    const played = this.path.advance(now);
    if (played) this.place(played.pose, played);
    else if (this.flight) this.flyOn(this.flight, now);
    if (this.drawing) return;
    if (this.dirty) void this.frame(false);
    else if (!this.still && now - this.movedAt > STILL_AFTER) void this.frame(true);
  }

  private flyOn(flight: Flight, now: number): void {
    const view = flight.at(now, ...this.pixels());
    if (view) this.place(view.pose, view);
    else this.go(flight.to);
  }

  // Limited by the device.
  pixels(): [number, number] {
    const { clientWidth, clientHeight } = this.canvas;
    const most = this.renderer.largestSide / Math.max(clientWidth, clientHeight, 1);
    const ratio = Math.min(devicePixelRatio, 2, most);
    return [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
  }

  private async frame(still: boolean): Promise<void> {
    this.drawing = true;
    this.dirty = false;
    const view = this.view();
    if (view.width > 0 && view.height > 0) {
      const chosen = element<HTMLSelectElement>('resolution').value;
      // frames of a film have one size
      const scale = chosen !== 'auto' ? Number(chosen) : still || this.path.filming ? 1 : this.pace.scale;
      const begin = performance.now();
      try {
        await this.screen(view, scale, this.options(still));
      } catch (error) {
        showError(error);
        return;
      }
      const took = performance.now() - begin;
      endPoster();
      this.path.drawn(view.pose);
      void this.notes.drawn(view, still);
      this.measures.drawn(view);
      this.crop.drawn(view);
      this.shown();
      if (!still && chosen === 'auto') this.pace.took(took);
      this.still = still && !this.dirty;
      this.report(took, scale);
      const { complete } = this.renderer.scene;
      document.documentElement.dataset.frame = !complete ? 'first' : this.still ? 'still' : 'moving';
    }
    this.drawing = false;
  }

  private report(milliseconds: number, scale: number): void {
    const { scene } = this.renderer;
    const [shown, all] = [scene.shown, scene.count].map((count) => count.toLocaleString('en'));
    const count = shown === all ? all : `${shown} of ${all}`;
    const rest = scene.complete ? '' : ' · the texture is on its way';
    element('status').textContent =
      `${milliseconds.toFixed(milliseconds < 10 ? 1 : 0)} ms · ${Math.round(100 * scale)} % · ${count} surfels${rest}`;
  }

  private bind(): void {
    onClick('orbit', () => this.setMode('orbit'));
    onClick('fly', () => this.setMode('fly'));
    onClick('home', () => this.go(this.first));
    onClick('previous', () => this.jump(this.chosen - 1));
    onClick('next', () => this.jump(this.chosen + 1));
    onClick('beside', () => this.toggleBeside());
    onClick('texture', () => this.toggle('texture'));
    onClick('exposure', () => this.toggle('exposure'));
    onClick('colors', () => {
      this.held = this.toggle('colors') ? null : this.controls.pose.position;
    });
    onClick('screenshot', () => void this.screenshot().catch(unsaved));
    onClick('share', () => void this.share());
    bindPanels(this.canvas, () => this.endPicking());
    this.canvas.addEventListener('dblclick', ({ clientX, clientY }) => void this.turnAround(clientX, clientY));
    element('resolution').addEventListener('change', () => this.changed());
    const show = element<HTMLSelectElement>('show');
    show.addEventListener('change', () => this.setShow(show.value as Show));
    element('camera').addEventListener('change', () => this.jump(this.chosen));
    addEventListener('keydown', (e) => this.shortcut(e));
    this.fillCameras();
  }

  private endPicking(): void {
    this.picker.stop();
    this.crop.choose(null);
    this.changed();
  }

  private cancel(): void {
    if (this.picker.waits) this.endPicking();
    else document.querySelector<HTMLElement>('.aside:not([hidden]) .close')?.click();
  }

  private shortcut(e: KeyboardEvent): void {
    if (writing(e.target)) return;
    if ((e.ctrlKey || e.metaKey) && e.code === 'KeyS') {
      e.preventDefault();
      void this.screenshot().catch(unsaved);
    }
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    if (e.key === 'Escape' && !element<HTMLDialogElement>('help').open) this.cancel();
    const id = KEYS[e.key] as string | undefined;
    if (id && !element(id).hidden) element(id).click();
  }

  private toggle(id: string): boolean {
    this.changed();
    return toggle(id);
  }

  private setMode(mode: Mode): void {
    this.controls.mode = mode;
    press(element('orbit'), mode === 'orbit');
    press(element('fly'), mode === 'fly');
    this.canvas.focus();
  }

  private setShow(show: Show): void {
    this.show = show;
    element<HTMLSelectElement>('show').value = show;
    this.changed();
  }

  private get chosen(): number {
    return Number(element<HTMLSelectElement>('camera').value);
  }
  private set chosen(k: number) {
    element<HTMLSelectElement>('camera').value = String(k);
  }

  private fillCameras(): void {
    element('cameras').hidden = !this.cameras.length;
    element('exposure').hidden = !this.cameras.some((camera) => camera.correction);
    element('beside').hidden = !this.cameras.some((camera) => camera.photograph);
    const list = element<HTMLSelectElement>('camera');
    this.cameras.forEach((camera, k) =>
      list.add(new Option(camera.name + (camera.heldOut ? ' · held out' : ''), `${k}`)),
    );
    this.chosen = Math.max(
      0,
      this.cameras.findIndex((camera) => camera.heldOut),
    );
  }

  private jump(k: number): void {
    if (!this.cameras.length) return; // keys remain when the buttons are hidden
    this.chosen = (k + this.cameras.length) % this.cameras.length;
    this.go(this.cameras[this.chosen]);
    this.setPhotograph();
  }

  private toggleBeside(): void {
    if (!this.toggle('beside')) this.setPhotograph();
    else if (this.cameras[this.chosen].photograph) this.jump(this.chosen);
    else this.jump(this.cameras.findIndex((camera) => camera.photograph));
  }

  private setPhotograph(): void {
    const { photograph } = this.cameras[this.chosen];
    const shown = pressed(element('beside'));
    element('photograph').hidden = !shown;
    if (!shown) return;
    const image = element<HTMLImageElement>('photograph-image');
    image.removeAttribute('src');
    element('photograph-name').textContent = photograph ? 'Photograph' : 'No photograph of this camera';
    const address = photograph ? this.bundle.photograph(photograph) : null;
    this.photograph = address;
    address?.then(
      (url) => this.photograph === address && (image.src = url),
      (error: unknown) => notify(reasonOf(error).message),
    );
  }

  private async screenshot(): Promise<void> {
    const view = this.view();
    const image = await this.renderer.read(view, this.options(true));
    const canvas = new OffscreenCanvas(view.width, view.height);
    canvas.getContext('2d')?.putImageData(image, 0, 0);
    download(this.fileName('png'), await canvas.convertToBlob({ type: 'image/png' }));
    this.changed();
  }

  private async share(): Promise<void> {
    history.replaceState(null, '', `${location.pathname}${location.search}${toHash(this.shared())}`);
    try {
      await navigator.clipboard.writeText(location.href);
      notify('The link to this view was copied.');
    } catch {
      notify('The link to this view is in the address bar.');
    }
  }
}
