// Declarations shared by the shaders of a baked scene, which the browser viewer and `ops.webgpu` draw with. csrc/core
// explains their formulas.

const SUPPORT: f32 = 3.0;
const SUPPORT2: f32 = 9.0;
const ALPHA_MAX: f32 = 0.99;
const ALPHA_MIN: f32 = 0.00392156862745098;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const LOW_PASS_REACH: f32 = 2.36;
const BETA_MAX: f32 = 4.0;
const LOG_SCALE_MAX: f32 = 30.0;
const COLOR_BIAS: f32 = 0.5;

// A stored surfel, 96 bytes; means are relative to the scene's origin.
struct Surfel {
  mean: vec3f,
  opacity_logit: f32,
  quat: vec4f,  // wxyz, unit
  log_scale: vec2f,
  beta_raw: f32,
  extent: f32,  // half side of the tile, scale units
  residual: vec3f,  // without a tile
  layer: u32,  // of the tile, 24 bits; above, 128 times the alpha without a tile
  base: vec3f,  // base of the view colour
  first_term: u32,
  tile: vec2u,  // first texel
  sides: u32,  // texels along u, and along v in the upper half; 0: no tile
  terms: u32,
}

// A projected surfel, 96 bytes; core/surfel.h defines the planes U, V and W.
struct Seen {
  center: vec2f,  // pixels
  u: vec2f,
  v: vec2f,
  w: vec2f,  // w1, w2
  w0: f32,
  z: f32,
  opacity: f32,
  beta: f32,
  color: vec3f,  // relu(f_view + 0.5)
  low_pass: f32,  // its height over that of the kernel
  axis: vec2f,  // unit vector along the bounding rectangle
  middle: vec2f,  // of the rectangle, pixels
  half_size: vec2f,  // along the axis and across
  normal_z: f32,
  level: u32,  // of its tile; TILE_LEVELS: mean residual only
}

struct Frame {
  rotation: array<vec4f, 3>,  // rows, world to camera
  center: vec3f,  // camera centre relative to the scene's origin
  alpha_scale: f32,  // m = alpha_scale * a texel's alpha multiplies sigma; 0: opaque scene
  color_center: vec3f,  // viewpoint for view colours; `center` unless frozen
  depth_unit: f32,  // of blended depths, which half floats must hold
  lens: vec4f,  // fx, fy, cx, cy
  size: vec2f,  // pixels
  near: f32,
  weight_bound: f32,
  offset: f32,  // residual = offset + scale * texel
  scale: f32,
  atlas: vec2f,  // size of a page, texels
  surfels: u32,
  kind: u32,  // of the view colours, VIEW_*
  layers: u32,  // batches of surfels, drawn in sequence
  show: u32,  // SHOW_*
  residuals: u32,  // 1: add residuals
  photo_pixel: f32,  // side of a photograph's pixel in pixels of the view: resize.wgsl
  detail: u32,  // DETAIL_*: available residuals
}

const DETAIL_MEANS: u32 = 0;  // means only, texels are still loading
const DETAIL_TEXELS: u32 = 1;
const DETAIL_ALL: u32 = 2;

const TILE_LEVELS: u32 = 3;  // of a tile: texels, and means of 2 x 2 and 4 x 4

// Blended quantity, see draw.wgsl.
const SHOW_COLOR: u32 = 0;
const SHOW_DEPTH: u32 = 1;
const SHOW_NORMAL: u32 = 2;
const SHOW_OVERDRAW: u32 = 3;
const SHOW_RESIDUAL: u32 = 4;

fn sigmoid(x: f32) -> f32 {
  let e = exp(-abs(x));
  return select(1.0, e, x < 0.0) / (1.0 + e);
}
