// Panel of the camera path: list of keyframes, playback, saving.
import { messageOf } from '../errors';
import { CameraPath, LONGEST, SECONDS, SHORTEST, within } from '../view/path';
import type { Pose, View } from '../view/pose';
import { button, download, element, make, onClick, press, toggle } from './dom';
import { notify } from './pages';
import type { Stage } from './stage';

const MOST_BYTES = 1 << 26; // of a path file
const TYPE = 'video/webm';
const BITS = 16e6; // per second
const SETTLING = 100; // milliseconds

const filmable = (): boolean =>
  typeof MediaRecorder !== 'undefined' &&
  'captureStream' in HTMLCanvasElement.prototype &&
  MediaRecorder.isTypeSupported(TYPE);

// Real-time recording of a canvas.
class Film {
  private readonly parts: Blob[] = [];
  private readonly recorder: MediaRecorder;

  constructor(canvas: HTMLCanvasElement) {
    this.recorder = new MediaRecorder(canvas.captureStream(), { mimeType: TYPE, videoBitsPerSecond: BITS });
    this.recorder.ondataavailable = ({ data }) => this.parts.push(data);
    this.recorder.start();
  }

  end(): Promise<Blob> {
    return new Promise((give) => {
      this.recorder.onstop = () => give(new Blob(this.parts, { type: TYPE }));
      // the last frame is still being encoded
      setTimeout(() => {
        this.recorder.stop();
        for (const track of this.recorder.stream.getTracks()) track.stop();
      }, SETTLING);
    });
  }
}

interface Playing {
  record: boolean;
  film: Film | null; // from the first drawn view on
  since: number; // time, ms, of the first view
  wanted: View | null; // the first or the last view, until it is drawn
}

export class PathPanel {
  private readonly path = new CameraPath();
  private playing: Playing | null = null;

  constructor(
    private readonly stage: Stage,
    private readonly canvas: HTMLCanvasElement,
  ) {
    onClick('add-keyframe', () => this.add());
    onClick('smooth', () => this.toggle('smooth'));
    onClick('loop', () => this.toggle('loop'));
    onClick('play', () => (this.playing ? this.stop() : this.play(false)));
    onClick('save-path', () => this.save());
    onClick('open-path', () => element('path-file').click());
    element('path-file').addEventListener('change', ({ target }) => {
      const [file] = (target as HTMLInputElement).files ?? [];
      if (file) void this.open(file);
    });
    onClick('record', () => (this.playing ? this.stop() : this.play(true)));
    element('seconds').addEventListener('change', ({ target }) => {
      const { valueAsNumber: seconds } = target as HTMLInputElement;
      if (seconds > 0) this.path.seconds = seconds;
      this.show();
    });
    element('record').hidden = !filmable();
    this.show();
  }

  // The current view while the path plays.
  advance(now: number): View | null {
    const { playing, path } = this;
    if (!playing || playing.wanted) return playing?.wanted ?? null;
    const time = (now - playing.since) / 1000;
    if (time < path.seconds) return this.view(time);
    const last = this.view(path.seconds);
    if (path.loop && !playing.record) playing.since = now;
    else playing.wanted = last;
    return last;
  }

  // Called with the pose that the canvas shows.
  drawn(pose: Pose): void {
    const { playing } = this;
    if (!playing || pose !== playing.wanted?.pose) return;
    if (playing.since) {
      this.stop();
      return;
    }
    playing.since = performance.now();
    playing.wanted = null;
    if (playing.record) playing.film = new Film(this.canvas);
  }

  stop(): void {
    if (!this.playing) return;
    const { film } = this.playing;
    this.playing = null;
    this.show();
    void film?.end().then((data) => download(this.stage.fileName('webm'), data));
  }

  get plays(): boolean {
    return this.playing !== null;
  }

  get filming(): boolean {
    return this.playing?.record === true;
  }

  private view(time: number): View {
    return this.path.at(time, ...this.stage.pixels());
  }

  private play(record: boolean): void {
    this.stop();
    this.playing = { record, film: null, since: 0, wanted: this.view(0) };
    this.show();
  }

  private add(): void {
    const { pose, lens } = this.stage.shared();
    this.path.keyframes.push({ pose, lens, seconds: SECONDS });
    this.stop();
    this.show();
  }

  private toggle(what: 'smooth' | 'loop'): void {
    this.path[what] = toggle(what);
    this.show();
  }

  private save(): void {
    const size = element<HTMLSelectElement>('path-size').value;
    const [width, height] = size ? size.split('x').map(Number) : this.stage.pixels().map((side) => side - (side % 2));
    const file = this.path.file(width, height);
    download('camera_path.json', new Blob([file], { type: 'application/json' }));
  }

  private async open(file: File): Promise<void> {
    this.stop();
    try {
      if (file.size > MOST_BYTES) throw new Error(`it has ${file.size} bytes, at most ${MOST_BYTES} are read.`);
      this.path.load(await file.text());
    } catch (error) {
      notify(`${file.name} is no camera path: ${messageOf(error)}`);
    }
    element<HTMLInputElement>('path-file').value = ''; // so that the same file can be chosen again
    for (const what of ['smooth', 'loop'] as const) press(element(what), this.path[what]);
    this.show();
  }

  private show(): void {
    const { keyframes, loop, seconds } = this.path;
    const list = element('keyframes');
    list.replaceChildren(
      ...keyframes.map((keyframe, k) => {
        const go = (): void => this.stage.go({ pose: keyframe.pose, lens: keyframe.lens });
        const remove = (): void => {
          this.stop();
          keyframes.splice(k, 1);
          this.show();
        };
        const to = (k + 1) % keyframes.length;
        const row = make('li', {}, button(`Keyframe ${k + 1}`, { className: 'name', title: 'Go there', run: go }));
        if (keyframes.length > 1 && (to || loop)) row.append(secondsOf(k + 1, to + 1, keyframe, () => this.show()));
        row.append(button('×', { ariaLabel: `Remove keyframe ${k + 1}`, title: 'Remove', run: remove }));
        return row;
      }),
    );
    element<HTMLInputElement>('seconds').value = seconds ? String(Number(seconds.toFixed(2))) : '';
    for (const id of ['seconds', 'play', 'save-path', 'record', 'smooth', 'loop', 'path-size']) {
      element<HTMLButtonElement>(id).disabled = keyframes.length < 2;
    }
    element('play').textContent = this.playing && !this.filming ? 'Stop' : 'Play';
    element('record').textContent = this.filming ? 'Stop' : 'Record';
  }
}

function secondsOf(from: number, to: number, keyframe: { seconds: number }, changed: () => void): HTMLElement {
  const ariaLabel = `Seconds from keyframe ${from} to ${to}`;
  const limits = { min: `${SHORTEST}`, max: `${LONGEST}`, step: 'any' };
  const input = make('input', { type: 'number', ...limits, ariaLabel });
  input.value = String(Number(keyframe.seconds.toFixed(2)));
  input.onchange = () => {
    const wanted = input.valueAsNumber;
    if (wanted > 0) keyframe.seconds = within(wanted);
    changed();
  };
  return make('label', { className: 'seconds' }, input, ' s');
}
