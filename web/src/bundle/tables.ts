// Written by scripts/page_tables.py.
export const SURFEL_WORDS = 24;
export const WORD = {
  mean: 0,
  opacityLogit: 3,
  quat: 4,
  logScale: 8,
  betaRaw: 10,
  extent: 11,
  residual: 12,
  layer: 15,
  base: 16,
  firstTerm: 19,
  tile: 20,
  sides: 22,
  terms: 23,
} as const;
export const KINDS = {
  sv: 0,
  'sv sites': 1,
  sh: 2,
  sb: 3,
  sg: 4,
} as const;
export const LEAN_WIDTH = {
  sv: 6,
  sh: 3,
  sb: 6,
  sg: 7,
} as const;
export const TERM_LIMITS = {
  sv: [20000000, 20000000, 20000000, 256, 256, 256],
  sh: [256, 256, 256],
  sb: [256, 256, 256, 1e4, 1e4, 1e4],
  sg: [1e6, 1e6, 1e6, 1e4, 256, 256, 256],
  'sv sites': [1e6, 1e6, 1e6, 1e4, 256, 256, 256],
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
  means: [0, 3, 1e9],
  log_scales: [8, 2, 104],
  opacity_logits: [3, 1, 1e4],
  beta_raw: [10, 1, 1e4],
  mean_residual: [12, 3, 256],
  view_base: [16, 3, 256],
} as const;
export const COLOR_LIMIT = 256;
export const EXTENTS = [1e-6, 16] as const;
export const EXTENT = 3;
export const UNIT_SLACK = 0.01;
export const ALPHA_MIN = 0.00392156862745098;
export const MAX_TERMS = 32;
export const POSITION_BITS = 17;
export const SMALLEST_SHARE = 0.0009765625;
export const GRID = 4;
export const ROWS = 64;
