// What a frame is drawn to on the page.
import type { View } from '../view/pose';
import type { Graphics } from './device';
import type { DrawOptions, Renderer } from './renderer';

// Draws a view for the canvas, at `scale` of its resolution; ends when it is drawn.
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

// Through the memory of the page: where the processor draws, there may be nothing to share a canvas with.
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
