// Written by scripts/page_tables.py.
export const FORMAT = 'bitymi-bundle';
export const NEWEST_MAJOR = 6;
export const EARLIER: Record<string, readonly string[]> = {
  '1.4': ['surfels.ply'], '2.3': ['surfels.ply'], '4.0': ['surfels.ply'], '5.0': ['surfels.bin'],
};
export const RANGES: Record<string, readonly [number, number]> = {
  'surfels.count': [0, 2147483647], 'surfels.sites': [0, 2147483647], 'surfels.terms': [0, 2147483647],
  'frame.center': [-1e9, 1e9], 'frame.scale': [5e-324, 1e9], 'frame.low': [-100, 100], 'columns.step': [1e-12, 1e6],
  'columns.bytes': [0, 1099511627776], 'atlas.texels': [0, 2147483647], 'atlas.step': [1e-6, 100],
  'atlas.page_width': [1, 1048576], 'atlas.page_rows': [1, 1048576], 'atlas.width': [1, 1048576],
  'atlas.height': [1, 1048576], 'atlas.layers': [1, 1048576], 'atlas.extent': [1e-6, 16], 'atlas.offset': [-256, 256],
  'atlas.scale': [5e-324, 512], 'atlas.alpha_scale': [5e-324, 2], 'atlas.clipped_fraction': [0, 1],
  'atlas.psnr': [-1000, 1000], 'render.near': [1e-9, 1e6], 'render.weight_bound': [0, 1], 'render.background': [0, 1],
  'bounds.min': [-1e9, 1e9], 'bounds.max': [-1e9, 1e9], 'world.transform': [-1e9, 1e9], 'world.scale': [5e-324, 1e12],
  'world.up': [-2, 2], 'world.metres_per_unit': [5e-324, 1e12], 'files.bytes': [0, 68719476736],
};
export const SURFEL_WORDS = 24;
export const WORD = {
  mean: 0, opacityLogit: 3, quat: 4, logScale: 8, betaRaw: 10, extent: 11, residual: 12, layer: 15, base: 16,
  firstTerm: 19, tile: 20, sides: 22, terms: 23,
} as const;
export const SEEN_BYTES = 96;
export const FRAME_BYTES = 160;
export const FRAME = {
  rotation: 0, center: 12, alphaScale: 15, colorCenter: 16, depthUnit: 19, lens: 20, size: 24, near: 26,
  weightBound: 27, offset: 28, scale: 29, atlas: 30, surfels: 32, kind: 33, layers: 34, show: 35, residuals: 36,
  photoPixel: 37, detail: 38,
} as const;
export const PLY: Record<string, readonly [number, number | null]> = {
  x: [0, null], y: [1, null], z: [2, null], rot_0: [4, null], rot_1: [5, null], rot_2: [6, null], rot_3: [7, null],
  scale_0: [8, null], scale_1: [9, null], opacity: [3, null], beta: [10, null],
};
export const COLUMNS = {
  place: 1, largest: 1, rotation: 3, log_scales: 2, opacity: 1, beta: 1, size: 1, residual: 3, alpha: 1, view_base: 3,
  extent: 1, view_count: 1,
} as const;
export const STEPPED: readonly string[] = ['place', 'rotation', 'log_scales', 'opacity', 'beta', 'extent', 'view_base', 'term_shape', 'term_color', 'residual'];
export const LATER: readonly string[] = [];
export const LINEAR: Record<string, { words: readonly number[]; limit: number } & Record<'least' | 'absent', number | null>> = {
  log_scales: { words: [8, 9], limit: 104, least: null, absent: null },
  opacity: { words: [3], limit: 1e4, least: 0.00392156862745098, absent: null },
  beta: { words: [10], limit: 1e4, least: 0.0009765625, absent: null },
};
export const KINDS = { sv: 0, 'sv sites': 1, sh: 2, sb: 3, sg: 4 } as const;
export const REDUCED_WIDTH = { sv: 6, sh: 3, sb: 6, sg: 7 } as const;
export const REDUCED_COUNTS: Record<string, readonly number[] | null> = {
  sv: null, sh: [0, 3, 8, 15], sb: null, sg: null,
};
export const TERM_LIMITS = {
  sv: [20000000, 20000000, 20000000, 256, 256, 256], sh: [256, 256, 256], sb: [256, 256, 256, 1e4, 1e4, 1e4],
  sg: [1e6, 1e6, 1e6, 1e4, 256, 256, 256], 'sv sites': [1e6, 1e6, 1e6, 1e4, 256, 256, 256],
} as const;
export const SHAPES = {
  sv: { at: 0, limits: [20000000, 20000000, 20000000] },
  sh: { at: 0, limits: [] },
  sb: { at: 3, limits: [1e4, 1e4, 1e4] },
  sg: { at: 0, limits: [1e6, 1e6, 1e6, 1e4] },
} as const;
export const WHOLE = {
  sv: { parts: { sv_sites: 3, sv_log_tau: 1, sv_rgb: 3 }, base: null, kind: 1 },
  sh: { parts: { sh_rest: 3 }, base: 'sh_dc', kind: 2 },
  sb: { parts: { sb_lobes: 6 }, base: 'sb_base', kind: 3 },
  sg: { parts: { sg_lobes: 7 }, base: 'sg_base', kind: 4 },
} as const;
export const LIMITS = {
  means: [0, 3, 1e9], log_scales: [8, 2, 104], opacity_logits: [3, 1, 1e4], beta_raw: [10, 1, 1e4],
  mean_residual: [12, 3, 256], view_base: [16, 3, 256],
} as const;
export const EXTENT = 3;
export const MAX_TERMS = 32;
export const COLOR_LIMIT = 256;
export const EXTENTS = [1e-6, 16] as const;
export const UNIT_SLACK = 0.01;
export const POSITION_BITS = 17;
export const SMALLEST_SHARE = 0.0009765625;
export const GRID = 4;
export const ROWS = 64;
export const SURFELS_PER_BYTE = 1;
export const SPARE_SURFELS = 4096;
export const TEXELS_PER_BYTE = 64;
export const SPARE_TEXELS = 1048576;
export const MOST_EXPONENT = 12;
export const MOST_COEFFICIENT = 16777216;
export const GRADES = [-8, 24] as const;
export const BLOCK = 1024;
export const DIGITS = 16;
export const ROUNDS = 8;
export const MOST_LAYERS = 64;
