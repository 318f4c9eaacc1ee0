// What a frame is drawn to on the page.
import type { View } from '../view/pose';
import type { Graphics } from './device';
import type { Look, Renderer } from './renderer';

export interface Screen {
  // Draws a view for the canvas, at `scale` of its resolution; ends when it is drawn.
  draw(view: View, scale: number, look: Look, farthest: number): Promise<void>;
}

class Direct implements Screen {
  private readonly context: GPUCanvasContext;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly renderer: Renderer,
    device: GPUDevice,
  ) {
    const context = canvas.getContext('webgpu');
    if (!context) throw new Error('The canvas gives no WebGPU context.');
    context.configure({ device, format: navigator.gpu.getPreferredCanvasFormat(), alphaMode: 'opaque' });
    this.context = context;
  }
  async draw(view: View, scale: number, look: Look, farthest: number): Promise<void> {
    if (this.canvas.width !== view.width || this.canvas.height !== view.height) {
      this.canvas.width = view.width;
      this.canvas.height = view.height;
    }
    this.renderer.draw(view, this.context.getCurrentTexture(), scale, look, farthest);
    await this.renderer.done();
  }
}

// Through the memory of the page: where the processor draws, there may be nothing to share a canvas with.
class Copied implements Screen {
  private readonly context: CanvasRenderingContext2D;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly renderer: Renderer,
  ) {
    const context = canvas.getContext('2d', { alpha: false });
    if (!context) throw new Error('The canvas gives no 2D context.');
    this.context = context;
  }
  async draw(view: View, scale: number, look: Look, farthest: number): Promise<void> {
    const [width, height] = [view.width, view.height].map((side) => Math.max(1, Math.round(side * scale)));
    const image = await this.renderer.read(view.scaledTo(width, height), look, farthest);
    this.canvas.width = width;
    this.canvas.height = height;
    this.context.putImageData(image, 0, 0);
  }
}

export const screenOf = (canvas: HTMLCanvasElement, renderer: Renderer, graphics: Graphics): Screen =>
  graphics.software ? new Copied(canvas, renderer) : new Direct(canvas, renderer, graphics.device);
