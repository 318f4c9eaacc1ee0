// Clicks on surfaces of the scene.
import type { Vec3 } from '../bundle/manifest';
import { View, moved } from '../view/pose';
import { element, press, pressed } from './dom';
import { notify } from './pages';
import type { Stage } from './stage';

const STILL_HAND = 5; // pixels of pointer movement that still count as a click
const STILL_FINGER = 15;

export class Picker {
  private pressedAt: [number, number] | null = null; // null: with several fingers
  private wanted: { button: string; run: (point: Vec3) => void } | null = null;

  constructor(
    private readonly stage: Stage,
    private readonly canvas: HTMLCanvasElement,
  ) {
    canvas.addEventListener('pointerdown', ({ isPrimary, button, clientX, clientY }) => {
      this.pressedAt = isPrimary && button === 0 ? [clientX, clientY] : null;
    });
    // not `click`, which a long touch does not fire
    canvas.addEventListener('pointerup', ({ clientX, clientY, pointerType }) => {
      const { wanted, pressedAt } = this;
      this.pressedAt = null;
      if (!wanted || !pressedAt) return;
      const apart = Math.hypot(clientX - pressedAt[0], clientY - pressedAt[1]);
      if (apart >= (pointerType === 'touch' ? STILL_FINGER : STILL_HAND)) return;
      void this.surface(clientX, clientY).then((point) => {
        if (wanted !== this.wanted) return; // an earlier click was taken
        if (!point) {
          notify('There is no surface at that pixel: click another.');
          return;
        }
        this.stop();
        wanted.run(point);
      });
    });
  }

  get waits(): boolean {
    return this.wanted !== null;
  }

  // Waits for a click on a surface, while a button stays pressed.
  start(button: string, run: (point: Vec3) => void): void {
    this.stop();
    this.wanted = { button, run };
    press(element(button), true);
    this.canvas.classList.add('placing');
  }

  stop(): void {
    if (this.wanted) press(element(this.wanted.button), false);
    this.wanted = null;
    this.canvas.classList.remove('placing');
  }

  // Starts if the button is not pressed, else stops.
  toggle(button: string, run: (point: Vec3) => void): void {
    if (pressed(element(button))) this.stop();
    else this.start(button, run);
  }

  // Finds the surface seen through a screen pixel.
  async surface(clientX: number, clientY: number): Promise<Vec3 | null> {
    const [view, box] = [this.stage.view(), this.canvas.getBoundingClientRect()];
    const x = ((clientX - box.left) / box.width) * view.width;
    const y = ((clientY - box.top) / box.height) * view.height;
    const pixel = new View(view.pose, view.fx, view.fy, view.cx - x + 0.5, view.cy - y + 0.5, 1, 1);
    const [depth] = (await this.stage.depths(pixel)).depth;
    if (!Number.isFinite(depth)) return null;
    const [right, down] = [((x - view.cx) / view.fx) * depth, ((y - view.cy) / view.fy) * depth];
    return moved(view.pose, right, down, depth).position;
  }
}
