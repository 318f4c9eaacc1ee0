// Presents the sums of draw.wgsl on the screen: over the background, or as a colour map.

struct Screen {
  background: vec4f,
  size: vec2f,  // viewport, pixels
  show: u32,  // SHOW_*
  most: f32,  // upper end of a map's range
  pixels: vec2f,  // size of the view
  first: vec2u,  // top left pixel of the part that was rendered; nothing covers the others
  samples: u32,  // per pixel and axis
  correction: array<vec4f, 3>,  // rows of [matrix | offset] of colours, as train.views.shown
}

@group(0) @binding(0) var<uniform> screen: Screen;
@group(0) @binding(1) var sums: texture_2d<f32>;
@group(0) @binding(2) var smooth_sampler: sampler;

@vertex
fn whole(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1) * 4.0 - 1.0, f32(vertex >> 1) * 4.0 - 1.0, 0.0, 1.0);
}

// Maps 0 to 1 to dark blue, green, yellow, red.
fn ramp(x: f32) -> vec3f {
  let t = clamp(x, 0.0, 1.0);
  let stops = array<vec3f, 5>(
    vec3f(0.10, 0.10, 0.25), vec3f(0.13, 0.42, 0.62), vec3f(0.25, 0.68, 0.45), vec3f(0.93, 0.80, 0.30),
    vec3f(0.83, 0.22, 0.16),
  );
  let at = t * 4.0;
  let k = min(u32(at), 3u);
  return mix(stops[k], stops[k + 1], at - f32(k));
}

// Resamples the sums at a pixel: interpolated, or the mean of its samples.
fn drawn(position: vec2f) -> vec4f {
  if screen.samples <= 1 { return textureSampleLevel(sums, smooth_sampler, position / screen.size, 0.0); }
  let part = textureDimensions(sums) / screen.samples;
  let at = vec2u(position / screen.size * screen.pixels) - screen.first;  // from 2^32 down where it is less
  if any(at >= part) { return vec4f(0.0, 0.0, 0.0, 1.0); }
  let first = screen.samples * at;
  var total = vec4f(0.0);
  for (var y = 0u; y < screen.samples; y++) {
    for (var x = 0u; x < screen.samples; x++) { total += textureLoad(sums, first + vec2u(x, y), 0); }
  }
  return total / f32(screen.samples * screen.samples);
}

@fragment
fn present(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let s = drawn(position.xy);
  let covered = 1.0 - s.a;
  switch screen.show {
    case SHOW_DEPTH: {
      let depth = s.r / max(covered, 1e-4); // 1: the farthest
      return vec4f(mix(screen.background.rgb, ramp(1.0 - depth), covered), 1.0);
    }
    case SHOW_NORMAL: {
      let normal = s.rgb / max(covered, 1e-4);
      return vec4f(mix(screen.background.rgb, normal * 0.5 + 0.5, covered), 1.0);
    }
    case SHOW_OVERDRAW: { return vec4f(ramp(s.r / screen.most), 1.0); }
    default: {
      let seen = vec4f(s.rgb, covered);
      let rows = screen.correction;
      let corrected = vec3f(dot(rows[0], seen), dot(rows[1], seen), dot(rows[2], seen));
      return vec4f(corrected + s.a * screen.background.rgb, 1.0);
    }
  }
}
