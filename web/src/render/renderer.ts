// Draws a scene to a target of sums, and from there to a screen.
import type { Vec3 } from '../bundle/manifest';
import { FRAME, FRAME_BYTES } from '../bundle/tables';
import type { View } from '../view/pose';
import { type Part, isFar, partOf, samplingOf, sizeOf } from '../view/size';
import type { Graphics } from './device';
import { type Programs, SHOW, type Show, type TargetFormat } from './programs';
import { type SceneOnDevice, STRIDE, group } from './scene';

export interface DrawOptions {
  show: Show;
  residuals: boolean;
  held: Vec3 | null; // viewpoint of view colours; null: the camera
  background: Vec3;
  correction: number[] | null; // of colours, before the background: matrix and offset [3, 4] by rows
  layers: number; // batches: draw.wgsl
  fine: boolean; // single precision, if the device can blend it
  farthest: number; // upper end of the depth map
}

interface Target {
  width: number;
  height: number;
  format: TargetFormat;
  samples: number; // per pixel, along each axis
  sums: GPUTexture;
  before: GPUTexture;
  batch: GPUBindGroup;
}

// A rendered view, of which the target has a part.
interface Drawn {
  target: Target;
  width: number; // of the whole view, pixels
  height: number;
  part: Part;
}

// Depth map along the camera's axis, row-major; infinite where coverage is below one half.
export interface Depths {
  width: number;
  height: number;
  depth: Float32Array;
}

const MOST_PIXELS = 1 << 22; // in a target
const SCREEN_BYTES = 112; // of present.wgsl's uniforms
const UNCHANGED = [...[1, 0, 0, 0], ...[0, 1, 0, 0], ...[0, 0, 1, 0]];
const MOST_OVERDRAW = 64; // upper end of the overdraw map

export class Renderer {
  private target: Target | null = null;
  private readonly screen: GPUBuffer;
  private readonly smooth: GPUSampler;

  constructor(
    private readonly graphics: Graphics,
    private readonly programs: Programs,
    readonly scene: SceneOnDevice,
  ) {
    const { device } = graphics;
    this.screen = device.createBuffer({ size: SCREEN_BYTES, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    this.smooth = device.createSampler({ magFilter: 'linear', minFilter: 'linear' });
  }

  // Whether depths of single pixels are blended in half floats.
  get coarse(): boolean {
    return !this.graphics.floats;
  }

  get largestSide(): number {
    return this.graphics.device.limits.maxTextureDimension2D;
  }

  private targetOf(width: number, height: number, samples: number, format: TargetFormat): Target {
    const t = this.target;
    if (t && t.samples === samples && t.width === width && t.height === height && t.format === format) return t;
    t?.sums.destroy();
    t?.before.destroy();
    const { device } = this.graphics;
    const { RENDER_ATTACHMENT, COPY_SRC, COPY_DST, TEXTURE_BINDING } = GPUTextureUsage;
    const make = (usage: number): GPUTexture => device.createTexture({ size: [width, height], format, usage });
    const sums = make(RENDER_ATTACHMENT | COPY_SRC | TEXTURE_BINDING);
    const before = make(TEXTURE_BINDING | COPY_DST);
    const batch = device.createBindGroup({
      layout: this.programs.layouts[2],
      entries: [
        { binding: 0, resource: { buffer: this.scene.layers, size: 16 } },
        { binding: 1, resource: before.createView() },
      ],
    });
    this.target = { width, height, samples, format, sums, before, batch };
    return this.target;
  }

  // Chooses the samples per pixel, more than one only at rest, and of a far view the part where surfels can be seen.
  private samplingOf(view: View, options: DrawOptions): [ReturnType<typeof samplingOf>, Part] {
    const whole: Part = [0, 0, view.width, view.height];
    const { info, surfels } = this.scene;
    if (!info.photographed?.length) return [{ samples: 1, photoPixel: 1 }, whole];
    const size = sizeOf(info.photographed, view);
    const shown = isFar(size) && options.fine ? partOf(surfels.words, view.from(surfels.origin), info.near) : whole;
    const [left, top, right, bottom] = shown;
    const [width, height] = [right - left, bottom - top];
    const most = options.fine ? Math.max(1, Math.floor(this.largestSide / Math.max(width, height))) : 1;
    const sampling = samplingOf(size, width * height, most, MOST_PIXELS);
    return [sampling, sampling.samples > 1 ? shown : whole];
  }

  private setFrame(view: View, width: number, height: number, photoPixel: number, options: DrawOptions): void {
    const { info, surfels, atlasSize, alphaScale, count } = this.scene;
    const data = new ArrayBuffer(FRAME_BYTES);
    const [f, u] = [new Float32Array(data), new Uint32Array(data)];
    const { right, down, forward } = view.pose;
    [right, down, forward].forEach((row, k) => f.set(row, FRAME.rotation + 4 * k));
    const relative = (at: Vec3): number[] => at.map((x, c) => x - surfels.origin[c]);
    const { position } = view.pose;
    f.set([...relative(position), alphaScale], FRAME.center);
    f.set([...relative(options.held ?? position), options.farthest], FRAME.colorCenter);
    f.set([view.fx, view.fy, view.cx, view.cy], FRAME.lens);
    f.set([width, height, info.near, info.weightBound], FRAME.size);
    f.set([info.atlas?.offset ?? 0, info.atlas?.scale ?? 1, ...atlasSize], FRAME.offset);
    u.set([count, surfels.kind, options.layers, SHOW[options.show], options.residuals ? 1 : 0], FRAME.surfels);
    f[FRAME.photoPixel] = photoPixel;
    u[FRAME.detail] = this.scene.detail;
    this.graphics.device.queue.writeBuffer(this.scene.frame, 0, data);
  }

  private encode(encoder: GPUCommandEncoder, view: View, options: DrawOptions): Drawn {
    const { scene, programs } = this;
    const [{ samples, photoPixel }, part] = this.samplingOf(view, options);
    const seen = view.part(...part);
    const [width, height] = [samples * seen.width, samples * seen.height];
    const format = options.fine && this.graphics.floats ? 'rgba32float' : 'rgba16float';
    const target = this.targetOf(width, height, samples, format);
    if (photoPixel < 1) scene.makeCoarser();
    this.setFrame(seen.scaledTo(width, height), width, height, photoPixel, options);
    encoder.clearBuffer(scene.visible);
    scene.encodeSorting(encoder);
    const pipeline = programs.draw(target.format, options.show === 'overdraw' ? 'count' : 'blend');
    const attachment = target.sums.createView();
    for (let k = 0; k < options.layers; k++) {
      if (k) encoder.copyTextureToTexture({ texture: target.sums }, { texture: target.before }, [width, height]);
      const work = encoder.beginRenderPass({
        colorAttachments: [
          { view: attachment, loadOp: k ? 'load' : 'clear', storeOp: 'store', clearValue: [0, 0, 0, 1] },
        ],
      });
      work.setPipeline(pipeline);
      work.setBindGroup(0, scene.drawn);
      work.setBindGroup(1, scene.pages);
      work.setBindGroup(2, target.batch, [k * STRIDE]);
      work.drawIndirect(scene.draws, 16 * k);
      work.end();
    }
    return { target, width: view.width, height: view.height, part };
  }

  private encodePresent(encoder: GPUCommandEncoder, drawn: Drawn, to: GPUTexture, options: DrawOptions): void {
    const { device } = this.graphics;
    const { target, width, height, part } = drawn;
    const pipeline = this.programs.present(to.format);
    const data = new ArrayBuffer(SCREEN_BYTES);
    const [f, u] = [new Float32Array(data), new Uint32Array(data)];
    f.set([...options.background, 1, to.width, to.height]);
    u[6] = SHOW[options.show];
    f.set([MOST_OVERDRAW, width, height], 7);
    u.set([part[0], part[1], target.samples], 10);
    f.set(options.correction ?? UNCHANGED, 16);
    device.queue.writeBuffer(this.screen, 0, data);
    const bound = group(device, pipeline.getBindGroupLayout(0), [this.screen, target.sums.createView(), this.smooth]);
    const work = encoder.beginRenderPass({
      colorAttachments: [{ view: to.createView(), loadOp: 'clear', storeOp: 'store' }],
    });
    work.setPipeline(pipeline);
    work.setBindGroup(0, bound);
    work.draw(3);
    work.end();
  }

  // Draws at `scale` of the screen's resolution; resolves when done.
  draw(view: View, to: GPUTexture, scale: number, options: DrawOptions): Promise<undefined> {
    const { queue } = this.graphics.device;
    const encoder = this.graphics.device.createCommandEncoder();
    const [width, height] = [to.width, to.height].map((side) => Math.max(1, Math.round(side * scale)));
    const drawn = this.encode(encoder, view.scaledTo(width, height), options);
    this.encodePresent(encoder, drawn, to, options);
    queue.submit([encoder.finish()]);
    return queue.onSubmittedWorkDone();
  }

  async depths(view: View, options: DrawOptions): Promise<Depths> {
    const encoder = this.graphics.device.createCommandEncoder();
    const { width, height, format, sums } = this.encode(encoder, view, { ...options, show: 'depth' }).target;
    const bytes = format === 'rgba32float' ? 16 : 8; // per pixel
    const rows = await this.rowsOf(encoder, sums, bytes);
    const depth = new Float32Array(width * height);
    for (let i = 0; i < depth.length; i++) {
      const row = rows[Math.floor(i / width)];
      const pixel = new DataView(row.buffer, row.byteOffset + (i % width) * bytes, bytes);
      const channel = (c: number): number =>
        bytes === 16 ? pixel.getFloat32(4 * c, true) : half(pixel.getUint16(2 * c, true));
      const covered = 1 - channel(3); // draw.wgsl
      const mean = (channel(0) / covered) * options.farthest;
      depth[i] = covered >= 0.5 && mean < Infinity ? mean : Infinity; // also NaN
    }
    return { width, height, depth };
  }

  async read(view: View, options: DrawOptions): Promise<ImageData> {
    const { device } = this.graphics;
    const size: [number, number] = [view.width, view.height];
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
    const to = device.createTexture({ size, format: 'rgba8unorm', usage });
    const encoder = device.createCommandEncoder();
    this.encodePresent(encoder, this.encode(encoder, view, options), to, options);
    const image = new ImageData(...size);
    (await this.rowsOf(encoder, to, 4)).forEach((row, y) => image.data.set(row, 4 * view.width * y));
    to.destroy();
    return image;
  }

  // Submits the work and reads a texture of `bytes` per pixel, row by row.
  private async rowsOf(encoder: GPUCommandEncoder, texture: GPUTexture, bytes: number): Promise<Uint8Array[]> {
    const { device } = this.graphics;
    const { width, height } = texture;
    const bytesPerRow = Math.ceil((bytes * width) / 256) * 256;
    const usage = GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ;
    const buffer = device.createBuffer({ size: bytesPerRow * height, usage });
    encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]);
    device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const mapped = buffer.getMappedRange().slice(0);
    buffer.destroy();
    return Array.from({ length: height }, (_, y) => new Uint8Array(mapped, y * bytesPerRow, bytes * width));
  }
}

// Converts a non-negative half-precision number.
const half = (bits: number): number => {
  const exponent = bits >> 10;
  if (exponent > 30) return bits & 1023 ? NaN : Infinity;
  return exponent ? 2 ** (exponent - 25) * (1024 + (bits & 1023)) : 2 ** -24 * bits;
};
