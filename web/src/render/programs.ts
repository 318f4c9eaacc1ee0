// Shader programs, as in bitymi_ns/ops/webgpu/programs.py.
import batches from '../../../bitymi_ns/ops/shaders/batches.wgsl?raw';
import bounds from '../../../bitymi_ns/ops/shaders/bounds.wgsl?raw';
import draw from '../../../bitymi_ns/ops/shaders/draw.wgsl?raw';
import halve from '../../../bitymi_ns/ops/shaders/halve.wgsl?raw';
import prepare from '../../../bitymi_ns/ops/shaders/prepare.wgsl?raw';
import present from '../../../bitymi_ns/ops/shaders/present.wgsl?raw';
import resize from '../../../bitymi_ns/ops/shaders/resize.wgsl?raw';
import scene from '../../../bitymi_ns/ops/shaders/scene.wgsl?raw';
import shareOut from '../../../bitymi_ns/ops/shaders/share_out.wgsl?raw';
import sort from '../../../bitymi_ns/ops/shaders/sort.wgsl?raw';
import viewColor from '../../../bitymi_ns/ops/shaders/view_color.wgsl?raw';

export const SHOW = { color: 0, depth: 1, normal: 2, overdraw: 3, residual: 4 } as const; // SHOW_* of scene.wgsl
export type Show = keyof typeof SHOW;
export type TargetFormat = 'rgba16float' | 'rgba32float';
export const SORT_ENTRIES = ['count', 'scan', 'scatter'] as const;
export type SortEntry = (typeof SORT_ENTRIES)[number];

const TRANSMITTANCE: GPUBlendComponent = { operation: 'add', srcFactor: 'zero', dstFactor: 'one-minus-src-alpha' };
const COLOR: Record<'blend' | 'count', GPUBlendComponent> = {
  blend: { operation: 'add', srcFactor: 'dst-alpha', dstFactor: 'one' },
  count: { operation: 'add', srcFactor: 'one', dstFactor: 'one' },
};

export class Programs {
  readonly prepare: GPUComputePipeline;
  readonly sort: Record<SortEntry, GPUComputePipeline>;
  readonly shareOut: GPUComputePipeline;
  readonly layouts: [GPUBindGroupLayout, GPUBindGroupLayout, GPUBindGroupLayout];
  private readonly drawing: GPUShaderModule;
  private readonly halving: GPUShaderModule;
  private readonly presenting: GPUShaderModule;
  private readonly made = new Map<string, GPURenderPipeline>();

  constructor(private readonly device: GPUDevice) {
    const module = (label: string, ...parts: string[]): GPUShaderModule =>
      device.createShaderModule({ label, code: parts.join('\n') });
    const compute = (from: GPUShaderModule, entryPoint: string): GPUComputePipeline =>
      device.createComputePipeline({ layout: 'auto', compute: { module: from, entryPoint } });
    this.prepare = compute(module('prepare', scene, viewColor, resize, bounds, prepare), 'prepare');
    const sorting = module('sort', sort);
    const sorts = SORT_ENTRIES.map((entry) => [entry, compute(sorting, entry)]);
    this.sort = Object.fromEntries(sorts) as Record<SortEntry, GPUComputePipeline>;
    this.shareOut = compute(module('share_out', scene, batches, shareOut), 'share_out');
    this.drawing = module('draw', scene, batches, resize, draw);
    this.halving = module('halve', halve);
    this.presenting = module('present', scene, present);
    this.layouts = this.makeLayouts();
  }

  private makeLayouts(): [GPUBindGroupLayout, GPUBindGroupLayout, GPUBindGroupLayout] {
    const { VERTEX, FRAGMENT } = GPUShaderStage;
    const make = (...resources: Omit<GPUBindGroupLayoutEntry, 'binding'>[]): GPUBindGroupLayout =>
      this.device.createBindGroupLayout({ entries: resources.map((of, binding) => ({ binding, ...of })) });
    const uniform = (buffer: GPUBufferBindingLayout): Omit<GPUBindGroupLayoutEntry, 'binding'> => ({
      visibility: VERTEX | FRAGMENT,
      buffer: { type: 'uniform', ...buffer },
    });
    const array = { visibility: VERTEX, buffer: { type: 'read-only-storage' } } as const;
    const atlas = { visibility: FRAGMENT, texture: { viewDimension: '2d-array' } } as const;
    return [
      make(uniform({}), array, array, array, array),
      make(atlas, { visibility: FRAGMENT, sampler: {} }, atlas),
      make(uniform({ hasDynamicOffset: true, minBindingSize: 16 }), {
        visibility: FRAGMENT,
        texture: { sampleType: 'unfilterable-float' },
      }),
    ];
  }

  private once(key: string, descriptor: GPURenderPipelineDescriptor): GPURenderPipeline {
    const pipeline = this.made.get(key) ?? this.device.createRenderPipeline(descriptor);
    this.made.set(key, pipeline);
    return pipeline;
  }

  draw(format: TargetFormat, how: 'blend' | 'count'): GPURenderPipeline {
    return this.once(`draw ${format} ${how}`, {
      layout: this.device.createPipelineLayout({ bindGroupLayouts: this.layouts }),
      vertex: { module: this.drawing, entryPoint: 'corner' },
      primitive: { topology: 'triangle-strip' },
      fragment: {
        module: this.drawing,
        entryPoint: 'surfel',
        targets: [{ format, blend: { color: COLOR[how], alpha: TRANSMITTANCE } }],
      },
    });
  }

  // `alpha`: colours weighted by alpha.
  halve(format: GPUTextureFormat, alpha: boolean): GPURenderPipeline {
    const entryPoint = `halve${alpha ? '_alpha' : ''}_${format === 'rgba8unorm' ? 'bytes' : 'floats'}`;
    return this.once(entryPoint, {
      layout: 'auto',
      vertex: { module: this.halving, entryPoint: 'page' },
      fragment: { module: this.halving, entryPoint, targets: [{ format }] },
    });
  }

  present(format: GPUTextureFormat): GPURenderPipeline {
    return this.once(`present ${format}`, {
      layout: 'auto',
      vertex: { module: this.presenting, entryPoint: 'whole' },
      fragment: { module: this.presenting, entryPoint: 'present', targets: [{ format }] },
    });
  }
}
