// Draws a batch of surfels, nearest first, as rectangles into a target with the sums of a pixel and, in alpha, the
// remaining transmittance. Blending does the rest of core/blend.h:
//   sums += transmittance * (sigma * color),   transmittance *= 1 - sigma.
//
// Blending does not expose a fragment's weight: tests of it (bound of residual and alpha, end of a pixel) use the
// transmittance before the batch, an upper bound that more batches tighten. docs/viewer.md has the image error.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> surfels: array<Surfel>;
@group(0) @binding(2) var<storage, read> seen: array<Seen>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> visible: u32;
@group(1) @binding(0) var atlas: texture_2d_array<f32>;
@group(1) @binding(1) var bilinear: sampler;
@group(1) @binding(2) var coarser: texture_2d_array<f32>;  // levels 1 and 2 of the tiles, as its levels 0 and 1
@group(2) @binding(0) var<uniform> layer: vec4u;  // x: batch
@group(2) @binding(1) var before: texture_2d<f32>;  // target before this batch

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) @interpolate(flat) center_u: vec4f,
  @location(1) @interpolate(flat) v_w: vec4f,
  @location(2) @interpolate(flat) w0_z_opacity_beta: vec4f,
  @location(3) @interpolate(flat) color_low_pass: vec4f,
  @location(4) @interpolate(flat) tile: vec4f,  // first texel, span; without a tile residual and alpha
  @location(5) @interpolate(flat) texel: vec4f,  // layer, -1 without a tile; 1 / (2 extent); normal z; level
}

@vertex
fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
  let i = order[layer_begin(visible, layer.x, frame.layers) + instance];
  let s = seen[i];
  let surfel = surfels[i];
  let side = vec2f(f32(vertex & 1) * 2.0 - 1.0, f32(vertex >> 1) * 2.0 - 1.0);
  let offset = side * s.half_size;
  let pixel = s.middle + s.axis * offset.x + vec2f(-s.axis.y, s.axis.x) * offset.y;
  let at = (pixel / frame.size * 2.0 - 1.0) * vec2f(1.0, -1.0);
  var out: Corner;
  out.position = vec4f(at, 0.0, 1.0);
  out.center_u = vec4f(s.center, s.u);
  out.v_w = vec4f(s.v, s.w);
  out.w0_z_opacity_beta = vec4f(s.w0, s.z, s.opacity, s.beta);
  out.color_low_pass = vec4f(s.color, s.low_pass);
  if s.level == TILE_LEVELS {
    out.tile = vec4f(surfel.residual, f32(surfel.layer >> 24) / 128.0);
    out.texel = vec4f(-1.0, 0.0, s.normal_z, 0.0);
  } else {
    let sides = vec2u(surfel.sides & 0xffff, surfel.sides >> 16) >> vec2u(s.level);
    out.tile = vec4f(vec2f(surfel.tile >> vec2u(s.level)), vec2f(sides) - 1.0);
    out.texel = vec4f(f32(surfel.layer & 0xffffff), 0.5 / surfel.extent, s.normal_z, f32(s.level));
  }
  return out;
}

struct Fragment {
  at: vec2f,  // u, v
  depth: f32,
  sigma: f32,
}

// core/kernel.h
fn beta_fragment(c: Corner, d: vec2f) -> Fragment {
  let w0 = c.w0_z_opacity_beta.x;
  let z = c.w0_z_opacity_beta.y;
  let w = w0 + dot(c.v_w.zw, d);
  let hit = w > 0.0 && w0 * z > frame.near * w;
  let inverse = 1.0 / select(1.0, w, hit);
  let at = select(vec2f(0.0), vec2f(dot(c.center_u.zw, d), dot(c.v_w.xy, d)) * inverse, hit);
  let rest = 1.0 - dot(at, at) / SUPPORT2;
  let inside = hit && rest > 0.0;
  let kernel = select(0.0, exp2(c.w0_z_opacity_beta.w * log2(select(1.0, rest, inside))), inside);
  let blur = c.color_low_pass.w * exp(-dot(d, d) * low_pass_sharp());
  var f: Fragment;
  f.at = clamp(at, vec2f(-SUPPORT), vec2f(SUPPORT));
  f.depth = select(w0 * z * inverse, z, blur > kernel);
  f.sigma = min(ALPHA_MAX, c.w0_z_opacity_beta.z * max(kernel, blur));
  return f;
}

// Fetches the residual and the factor of sigma.
fn texels(c: Corner, at: vec2f) -> vec4f {
  if c.texel.x < 0.0 { return c.tile; }
  let span = c.tile.zw;
  let texel = c.tile.xy + clamp(at * (span + 1.0) * c.texel.y + 0.5 * span, vec2f(0.0), span) + 0.5;
  let layer = u32(c.texel.x);
  var stored: vec4f;
  if c.texel.w == 0.0 {
    stored = textureSampleLevel(atlas, bilinear, texel / frame.atlas, layer, 0.0);
  } else {
    let level = c.texel.w - 1.0;
    stored = textureSampleLevel(coarser, bilinear, texel / vec2f(textureDimensions(coarser, u32(level))), layer, level);
  }
  return vec4f(frame.offset + frame.scale * stored.rgb, frame.alpha_scale * stored.a);
}

@fragment
fn surfel(c: Corner) -> @location(0) vec4f {
  let d = c.position.xy - c.center_u.xy;
  var f = beta_fragment(c, d);
  if f.sigma < ALPHA_MIN { discard; }
  var front = 1.0;
  if layer.x > 0 { front = textureLoad(before, vec2i(c.position.xy), 0).a; }
  if front < TRANSMITTANCE_MIN { discard; }
  var texel = vec4f(0.0);
  let cut = frame.alpha_scale > 0.0 && f.sigma * front >= frame.weight_bound;
  if cut {
    texel = texels(c, f.at);
    f.sigma = min(ALPHA_MAX, f.sigma * texel.a);
    if f.sigma < ALPHA_MIN { discard; }
  }
  let colored = frame.residuals != 0 && (frame.show == SHOW_COLOR || frame.show == SHOW_RESIDUAL);
  let textured = colored && f.sigma * front >= frame.weight_bound;
  if textured && !cut { texel = texels(c, f.at); }
  switch frame.show {
    case SHOW_DEPTH: { return vec4f(f.sigma * (f.depth / frame.depth_unit), f.sigma * c.w0_z_opacity_beta.w, f.sigma, f.sigma); }
    case SHOW_NORMAL: {
      return vec4f(f.sigma * vec3f(-c.v_w.zw * frame.lens.xy, c.texel.z), f.sigma);
    }
    case SHOW_OVERDRAW: { return vec4f(1.0, 0.0, 0.0, f.sigma); }
    case SHOW_RESIDUAL: {
      var shift = vec3f(0.0);
      if textured { shift = texel.rgb; }
      return vec4f(f.sigma * max(shift + 0.5, vec3f(0.0)), f.sigma);
    }
    default: {
      var color = c.color_low_pass.xyz;
      if textured { color = max(color + texel.rgb, vec3f(0.0)); }
      return vec4f(f.sigma * color, f.sigma);
    }
  }
}
