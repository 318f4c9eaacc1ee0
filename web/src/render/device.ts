// WebGPU device.
import { NoGraphics, ViewerError, tooLarge } from '../errors';

const NEEDS =
  'Chrome and Edge from 113, Safari from 26 and Firefox from 141 have it. Update the browser and the graphics driver, ' +
  'and look whether hardware acceleration is switched on. Pages need https, or an address on this machine.';

export async function openDevice() {
  const gpu = (navigator as Partial<Navigator>).gpu;
  if (!gpu) throw new NoGraphics('This browser has no WebGPU', 'The viewer draws with WebGPU.', NEEDS);
  const adapter = await gpu.requestAdapter({ powerPreference: 'high-performance' });
  if (!adapter) throw new NoGraphics('No graphics device', 'WebGPU finds nothing here that could draw.', NEEDS);
  const wanted = ['texture-compression-bc', 'float32-blendable', 'float32-filterable'] as GPUFeatureName[];
  const features = wanted.filter((name) => adapter.features.has(name));
  const { maxTextureDimension2D, maxTextureArrayLayers, maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
  const { maxComputeWorkgroupsPerDimension } = adapter.limits;
  const { architecture, device: name, description } = adapter.info;
  const device = await adapter.requestDevice({
    requiredFeatures: features,
    requiredLimits: {
      ...{ maxTextureDimension2D, maxTextureArrayLayers, maxStorageBufferBindingSize, maxBufferSize },
      maxComputeWorkgroupsPerDimension,
    },
  });
  return {
    device,
    blocks: features.includes(wanted[0]), // BC7 textures
    floats: features.includes(wanted[1]) && features.includes(wanted[2]), // rgba32float can be blended and filtered
    software: adapter.info.isFallbackAdapter || /swiftshader|llvmpipe/i.test(`${architecture} ${name} ${description}`),
  };
}
export type Graphics = Awaited<ReturnType<typeof openDevice>>;

const DRIVER = 'Reload the page. If it happens again, update the browser and the graphics driver.';

// Calls `stop` with device errors: validation, out of memory, loss.
export function watch(device: GPUDevice, stop: (error: unknown) => void): void {
  device.addEventListener('uncapturederror', ({ error }) => {
    if (error instanceof GPUOutOfMemoryError) stop(tooLarge('The graphics device has not enough memory for it.'));
    else stop(new ViewerError('The graphics device reports an error', error.message, DRIVER));
  });
  void device.lost.then(({ reason, message }) => {
    if (reason === 'destroyed') return;
    stop(new ViewerError('The graphics device was lost', message || 'The browser does not say why.', DRIVER));
  });
}
