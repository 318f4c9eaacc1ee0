// Drawing to the page's canvas.
import type { View } from '../view/pose';
import type { Graphics } from './device';
import type { DrawOptions, Renderer } from './renderer';

const FRAME_MILLISECONDS = 1000 / 60;
const LEAST_SCALE = 0.2;

// Draws at `scale` of the canvas's resolution; resolves when done.
export type Screen = (view: View, scale: number, options: DrawOptions) => Promise<unknown>;

function direct(canvas: HTMLCanvasElement, renderer: Renderer, device: GPUDevice): Screen {
  const context = canvas.getContext('webgpu');
  if (!context) throw new Error('The canvas gives no WebGPU context.');
  context.configure({ device, format: navigator.gpu.getPreferredCanvasFormat(), alphaMode: 'opaque' });
  return (view, scale, options) => {
    const { width, height } = view;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    return renderer.draw(view, context.getCurrentTexture(), scale, options);
  };
}

// Copies frames through the page's memory, as software adapters may be unable to share a canvas.
function copied(canvas: HTMLCanvasElement, renderer: Renderer): Screen {
  const context = canvas.getContext('2d', { alpha: false });
  if (!context) throw new Error('The canvas gives no 2D context.');
  return async (view, scale, options) => {
    const [width, height] = [view.width, view.height].map((side) => Math.max(1, Math.round(side * scale)));
    const image = await renderer.read(view.scaledTo(width, height), options);
    Object.assign(canvas, { width, height });
    context.putImageData(image, 0, 0);
  };
}

export const screenOf = (canvas: HTMLCanvasElement, renderer: Renderer, graphics: Graphics): Screen =>
  graphics.software ? copied(canvas, renderer) : direct(canvas, renderer, graphics.device);

// Resolution scale that keeps 60 frames per second while the camera moves.
export class Pace {
  scale = 1;
  milliseconds = 0; // per frame, smoothed

  took(milliseconds: number): void {
    this.milliseconds = this.milliseconds ? 0.7 * this.milliseconds + 0.3 * milliseconds : milliseconds;
    const wish = this.scale * Math.sqrt((0.85 * FRAME_MILLISECONDS) / Math.max(this.milliseconds, 0.5));
    const next = Math.min(1, Math.max(LEAST_SCALE, wish));
    // small steps, and none for small differences, as each reallocates targets
    if (Math.abs(next - this.scale) > 0.08 * this.scale) {
      const step = 0.5 * (next - this.scale);
      this.scale += Math.sign(step) * Math.max(Math.abs(step), Math.min(0.05, Math.abs(2 * step)));
      this.milliseconds = 0;
    }
  }
}
