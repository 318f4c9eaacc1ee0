// Halves a page of an atlas: means of 2 x 2 texels, as `ops.tile_levels`. With alpha, colours are weighted by it unless
// all four are 0: transparent texels do not tint their neighbours.

@group(0) @binding(0) var finer: texture_2d<f32>;

@vertex
fn page(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1) * 4.0 - 1.0, f32(vertex >> 1) * 4.0 - 1.0, 0.0, 1.0);
}

fn texels(position: vec4f) -> array<vec4f, 4> {
  let at = 2 * vec2i(position.xy);
  return array<vec4f, 4>(
    textureLoad(finer, at, 0), textureLoad(finer, at + vec2i(1, 0), 0), textureLoad(finer, at + vec2i(0, 1), 0),
    textureLoad(finer, at + vec2i(1, 1), 0),
  );
}
fn sum(t: array<vec4f, 4>) -> vec4f {
  return t[0] + t[1] + t[2] + t[3];
}
fn weighted(t: array<vec4f, 4>) -> vec3f {
  return t[0].a * t[0].rgb + t[1].a * t[1].rgb + t[2].a * t[2].rgb + t[3].a * t[3].rgb;
}

// Averages bytes, rounded.
fn bytes(t: array<vec4f, 4>) -> vec4f {
  return floor((round(sum(t) * 255.0) + 2.0) / 4.0) / 255.0;
}
@fragment
fn halve_bytes(@builtin(position) position: vec4f) -> @location(0) vec4f {
  return bytes(texels(position));
}
@fragment
fn halve_alpha_bytes(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let t = texels(position);
  let mean = bytes(t);
  let total = u32(round(sum(t).a * 255.0));
  if total == 0 { return mean; }
  let colors = (vec3u(round(weighted(t) * 65025.0)) + total / 2) / total;
  return vec4f(vec3f(colors) / 255.0, mean.a);
}

@fragment
fn halve_floats(@builtin(position) position: vec4f) -> @location(0) vec4f {
  return sum(texels(position)) / 4.0;
}
@fragment
fn halve_alpha_floats(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let t = texels(position);
  let mean = sum(t) / 4.0;
  if mean.a == 0.0 { return mean; }
  return vec4f(weighted(t) / (4.0 * mean.a), mean.a);
}
