// A bundle in GPU memory.
import { decodeBc7 } from '../bundle/bc7';
import { type Pages, blockOf } from '../bundle/ktx2';
import type { Manifest } from '../bundle/manifest';
import { type Surfels } from '../bundle/surfels';
import { BLOCK, DIGITS, FRAME_BYTES, MOST_LAYERS, ROUNDS, SEEN_BYTES, SURFEL_WORDS, WORD } from '../bundle/tables';
import { tooLarge } from '../errors';
import type { Graphics } from './device';
import { GROUP } from './limits';
import { type Programs, SORT_ENTRIES, type SortEntry } from './programs';

export const STRIDE = 256; // offset alignment of the batches' uniforms
const NO_OPACITY = -1e4; // logit
const NO_PAGES: Pages = { width: 1, height: 1, layers: [new Uint8Array(4)], format: 'uint8' };

type Resource = GPUBuffer | GPUTextureView | GPUSampler;

export function group(device: GPUDevice, layout: GPUBindGroupLayout, resources: (Resource | null)[]): GPUBindGroup {
  const entries: GPUBindGroupEntry[] = [];
  resources.forEach((r, binding) => {
    if (r !== null) entries.push({ binding, resource: r instanceof GPUBuffer ? { buffer: r } : r });
  });
  return device.createBindGroup({ layout, entries });
}

export class SceneOnDevice {
  readonly count: number;
  shown: number; // surfels that are not hidden
  readonly frame: GPUBuffer;
  readonly visible: GPUBuffer;
  readonly draws: GPUBuffer;
  readonly layers: GPUBuffer;
  readonly drawn: GPUBindGroup;
  readonly decoded: boolean; // BC7 decoded on the CPU, if the device does not support it
  pages: GPUBindGroup;
  complete: boolean; // texels, if any, are loaded
  private atlas: GPUTexture;
  private coarser: GPUTexture | null = null;
  private readonly device: GPUDevice;
  private readonly preparing: GPUBindGroup;
  private readonly rounds: Record<SortEntry, GPUBindGroup>[] = [];
  private readonly sharing: GPUBindGroup;
  private readonly blocks: number;
  private readonly stored: GPUBuffer;

  constructor(
    private readonly graphics: Graphics,
    private readonly programs: Programs,
    readonly info: Manifest,
    readonly surfels: Surfels,
    pages: Pages | null,
  ) {
    const { device } = graphics;
    this.device = device;
    this.count = this.shown = surfels.count;
    this.blocks = Math.ceil(Math.max(1, this.count) / BLOCK);
    const { STORAGE, UNIFORM, COPY_DST, INDIRECT } = GPUBufferUsage;
    const n = Math.max(1, this.count);
    const stored = (this.stored = this.upload(surfels.words, STORAGE));
    const terms = this.upload(surfels.terms, STORAGE);
    const seen = this.empty(SEEN_BYTES * n, STORAGE);
    const keys = [0, 1].map(() => this.empty(4 * n, STORAGE));
    const order = [0, 1].map(() => this.empty(4 * n, STORAGE));
    const table = this.empty(4 * DIGITS * this.blocks, STORAGE);
    this.frame = this.empty(FRAME_BYTES, UNIFORM | COPY_DST);
    this.visible = this.empty(4, STORAGE | COPY_DST);
    this.draws = this.empty(16 * MOST_LAYERS, STORAGE | INDIRECT);
    const numbers = new Uint32Array((MOST_LAYERS * STRIDE) / 4);
    for (let k = 0; k < MOST_LAYERS; k++) numbers[(k * STRIDE) / 4] = k;
    this.layers = this.upload(numbers, UNIFORM);
    const bind = (layout: GPUBindGroupLayout, ...r: (Resource | null)[]): GPUBindGroup => group(device, layout, r);
    this.preparing = bind(
      programs.prepare.getBindGroupLayout(0),
      ...[this.frame, stored, terms, seen, keys[0], order[0], this.visible],
    );
    for (let k = 0; k < ROUNDS; k++) {
      const [from, to] = [k % 2, 1 - (k % 2)];
      const uniform = this.upload(new Uint32Array([this.count, this.blocks, 4 * k, 0]), UNIFORM);
      const given = [uniform, keys[from], order[from], keys[to], order[to], table];
      const used: Record<SortEntry, number[]> = { count: [0, 1, 5], scan: [0, 5], scatter: [0, 1, 2, 3, 4, 5] };
      const groups = SORT_ENTRIES.map((entry) => [
        entry,
        bind(programs.sort[entry].getBindGroupLayout(0), ...given.map((r, i) => (used[entry].includes(i) ? r : null))),
      ]);
      this.rounds.push(Object.fromEntries(groups) as Record<SortEntry, GPUBindGroup>);
    }
    this.sharing = bind(programs.shareOut.getBindGroupLayout(0), this.frame, this.visible, this.draws);
    this.drawn = bind(programs.layouts[0], this.frame, stored, seen, order[0], this.visible);
    this.decoded = pages?.format === 'bc7' && !graphics.blocks;
    this.complete = pages !== null || info.atlas === null;
    this.atlas = this.texture(pages);
    this.pages = this.boundPages();
  }

  get atlasSize(): [number, number] {
    return [this.atlas.width, this.atlas.height];
  }
  get alphaScale(): number {
    return this.info.atlas?.alphaScale ?? 0;
  }
  // DETAIL_* of scene.wgsl.
  get detail(): number {
    return this.complete ? (this.surfels.means ? 2 : 1) : 0;
  }

  // Hides the surfels whose entry is 0, by an opacity that prepare.wgsl skips; null: shows all.
  hide(kept: Uint8Array | null): void {
    const words = kept ? this.surfels.words.slice() : this.surfels.words;
    kept?.forEach((shown, i) => {
      if (!shown) words[i * SURFEL_WORDS + WORD.opacityLogit] = NO_OPACITY;
    });
    this.shown = kept ? kept.reduce((sum, shown) => sum + shown, 0) : this.count;
    if (this.count) this.device.queue.writeBuffer(this.stored, 0, words as Float32Array<ArrayBuffer>);
  }

  setTexels(pages: Pages): void {
    this.atlas = this.texture(pages);
    this.coarser = null;
    this.complete = true;
    this.pages = this.boundPages();
  }

  // Coarser levels that are not sampled may be any texture.
  private boundPages(): GPUBindGroup {
    const [atlas, coarser] = [this.atlas, this.coarser ?? this.atlas].map((t) =>
      t.createView({ dimension: '2d-array' }),
    );
    const sampler = this.device.createSampler({ magFilter: 'linear', minFilter: 'linear' });
    return group(this.device, this.programs.layouts[1], [atlas, sampler, coarser]);
  }

  // Makes the levels 1 and 2 of the tiles, for views smaller than the photographs.
  makeCoarser(): void {
    if (this.coarser || !this.complete) return;
    const { width, height, depthOrArrayLayers: layers } = this.atlas;
    const format = this.atlas.format === 'rgba16float' ? 'rgba16float' : 'rgba8unorm';
    const size: [number, number] = [Math.max(1, width >> 1), Math.max(1, height >> 1)];
    const coarser = this.device.createTexture({
      size: [...size, layers],
      format,
      mipLevelCount: Math.max(...size) > 1 ? 2 : 1,
      usage: GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.RENDER_ATTACHMENT,
    });
    const pipeline = this.programs.halve(format, this.alphaScale > 0);
    const encoder = this.device.createCommandEncoder();
    const page = (texture: GPUTexture, baseMipLevel: number, baseArrayLayer: number): GPUTextureView =>
      texture.createView({ dimension: '2d', baseMipLevel, mipLevelCount: 1, baseArrayLayer, arrayLayerCount: 1 });
    for (let level = 0; level < coarser.mipLevelCount; level++) {
      for (let layer = 0; layer < layers; layer++) {
        const finer = level ? page(coarser, level - 1, layer) : page(this.atlas, 0, layer);
        const work = encoder.beginRenderPass({
          colorAttachments: [{ view: page(coarser, level, layer), loadOp: 'clear', storeOp: 'store' }],
        });
        work.setPipeline(pipeline);
        work.setBindGroup(0, group(this.device, pipeline.getBindGroupLayout(0), [finer]));
        work.draw(3);
        work.end();
      }
    }
    this.device.queue.submit([encoder.finish()]);
    this.coarser = coarser;
    this.pages = this.boundPages();
  }

  private empty(size: number, usage: number): GPUBuffer {
    const { maxBufferSize, maxStorageBufferBindingSize } = this.device.limits;
    if (size > maxBufferSize || (usage & GPUBufferUsage.STORAGE && size > maxStorageBufferBindingSize)) {
      throw tooLarge(`It needs ${(size / 1e6).toFixed(0)} MB of graphics memory in one piece.`);
    }
    return this.device.createBuffer({ size, usage });
  }
  private upload(data: Float32Array | Uint32Array, usage: number): GPUBuffer {
    const buffer = this.empty(Math.max(96, data.byteLength), usage | GPUBufferUsage.COPY_DST);
    if (data.byteLength) this.device.queue.writeBuffer(buffer, 0, data as Float32Array<ArrayBuffer>);
    return buffer;
  }

  private texture(pages: Pages | null): GPUTexture {
    const { width, height, layers, format } = pages ?? NO_PAGES;
    const decode = format === 'bc7' && !this.graphics.blocks;
    const names = { bc7: decode ? 'rgba8unorm' : 'bc7-rgba-unorm', uint8: 'rgba8unorm', fp16: 'rgba16float' } as const;
    const texture = this.device.createTexture({
      size: [width, height, layers.length],
      format: names[format],
      usage: GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST,
    });
    const { side, bytes } = decode ? blockOf('uint8') : blockOf(format);
    layers.forEach((layer, k) => {
      const data = decode ? decodeBc7(layer, width, height) : layer;
      this.device.queue.writeTexture(
        { texture, origin: [0, 0, k] },
        data as Uint8Array<ArrayBuffer>,
        { bytesPerRow: Math.ceil(width / side) * bytes, rowsPerImage: Math.ceil(height / side) },
        [width, height, 1],
      );
    });
    return texture;
  }

  // Projection, sorting, and division into batches.
  encodeSorting(encoder: GPUCommandEncoder): void {
    const work = encoder.beginComputePass();
    const run = (pipeline: GPUComputePipeline, bound: GPUBindGroup, groups: number): void => {
      work.setPipeline(pipeline);
      work.setBindGroup(0, bound);
      work.dispatchWorkgroups(groups);
    };
    run(this.programs.prepare, this.preparing, Math.ceil(Math.max(1, this.count) / GROUP));
    for (const round of this.rounds) {
      run(this.programs.sort.count, round.count, this.blocks);
      run(this.programs.sort.scan, round.scan, 1);
      run(this.programs.sort.scatter, round.scatter, this.blocks);
    }
    run(this.programs.shareOut, this.sharing, 1);
    work.end();
  }
}
