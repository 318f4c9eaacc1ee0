// A page of an atlas at half its size: means of 2 x 2 texels.

@group(0) @binding(0) var finer: texture_2d<f32>;

@vertex
fn page(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1) * 4.0 - 1.0, f32(vertex >> 1) * 4.0 - 1.0, 0.0, 1.0);
}

fn sum(position: vec4f) -> vec4f {
  let at = 2 * vec2i(position.xy);
  return textureLoad(finer, at, 0) + textureLoad(finer, at + vec2i(1, 0), 0) + textureLoad(finer, at + vec2i(0, 1), 0)
    + textureLoad(finer, at + vec2i(1, 1), 0);
}

// Of bytes, rounded as `ops.tile_levels` rounds them.
@fragment
fn halve_bytes(@builtin(position) position: vec4f) -> @location(0) vec4f {
  return floor((round(sum(position) * 255.0) + 2.0) / 4.0) / 255.0;
}

@fragment
fn halve_floats(@builtin(position) position: vec4f) -> @location(0) vec4f {
  return sum(position) / 4.0;
}
