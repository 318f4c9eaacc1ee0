// Adaptation of surfels to views of another size than the photographs, as core/resize.h and core/texel.h.

// Variance that a pixel adds along each axis, pixels^2.
fn pixel_variance() -> f32 {
  let p = frame.photo_pixel;
  return max(0.0, (1.0 - p * p) / 12.0);
}
// 1 / squared radius of the low pass.
fn low_pass_sharp() -> f32 {
  let p = frame.photo_pixel;
  return 1.0 / (p * p + 2.0 * pixel_variance());
}

// Widens the surfel by the pixel and its low pass by the view's size; `low_pass` then holds the height of the low pass
// over that of the kernel.
fn resized(seen: Seen) -> Seen {
  var s = seen;
  let variance = pixel_variance();
  let p = frame.photo_pixel;
  let share = p * p * low_pass_sharp();
  s.low_pass = share;
  if variance == 0.0 || !(s.w0 > 0.0) { return s; }
  // M' = (1 + c M M^T)^(-1/2) M, from positive terms only
  let c = variance * 2.0 / SUPPORT2 * (s.beta + 2.0);
  let u = s.u / s.w0;
  let v = s.v / s.w0;
  let uu = c * dot(u, u);
  let uv = c * dot(u, v);
  let vv = c * dot(v, v);
  let across = c * (u.x * v.y - u.y * v.x);
  let root = sqrt(1.0 + uu + vv + across * across);
  let k = 1.0 / (root * sqrt(2.0 + uu + vv + 2.0 * root));
  let inverse = vec3f(1.0 + vv + root, -uv, 1.0 + uu + root) * k;
  s.u = inverse.x * seen.u + inverse.y * seen.v;
  s.v = inverse.y * seen.u + inverse.z * seen.v;
  s.opacity = seen.opacity / root;
  s.low_pass = share * root;
  return s;
}

// Selects the level of a tile with about one texel per pixel.
fn tile_level(s: Seen, surfel: Surfel) -> u32 {
  if surfel.sides == 0 || frame.detail == DETAIL_MEANS { return TILE_LEVELS; }
  let p = frame.photo_pixel;
  if !(p < 1.0) { return 0; }
  let sides = vec2u(surfel.sides & 0xffff, surfel.sides >> 16);
  let k = 0.5 / (surfel.extent * s.w0);
  let area = sqrt(dot(s.u, s.u) * dot(s.v, s.v)) * k * k * f32(sides.x) * f32(sides.y);  // texels per pixel
  let most = 1.0 / (p * p);
  var level = 0u;
  for (var size = 2.0; level < TILE_LEVELS && area > size && most >= size; size *= 4.0) { level++; }
  if level > 0 && (max(sides.x, sides.y) >> level) <= 2 {
    if frame.detail == DETAIL_ALL { return TILE_LEVELS; }
    return 0;
  }
  level = min(level, TILE_LEVELS - 1);
  let grid = surfel.tile.x | surfel.tile.y | sides.x | sides.y;
  while level > 0 && (grid & ((1u << level) - 1)) != 0 { level--; }
  return level;
}
