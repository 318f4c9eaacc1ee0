// Screen rectangles that bound a surfel: the level set sigma = 1/255 of the kernel and of the low pass. As
// core/footprint.h, but along the axes of the surfel's image: a long thin surfel then costs only its own area.

struct Rectangle {
  visible: bool,
  axis: vec2f,
  middle: vec2f,  // pixels
  half_size: vec2f,
}

const BOUND_PAD: f32 = 0.02;  // pixels
const WIDEST: f32 = 1e5;  // pixels; larger surfels cover the whole screen
const LEAST_ANGLE: f32 = 1e-6;  // between the lines U = 0 and V = 0; below, the disc's image is lost to rounding

// Squared radius in scale units where the kernel is exp(-level) of its maximum, slightly enlarged.
fn level_radius2(level: f32, beta: f32) -> f32 {
  return SUPPORT2 * min(1.0, (1.0 - exp(-level / max(beta, 1e-6))) * 1.0002 + 4e-6);
}

// Major axis of the ellipse [p q] (unit circle).
fn major_axis(p: vec2f, q: vec2f) -> vec2f {
  let angle = 0.5 * atan2(2.0 * (p.x * p.y + q.x * q.y), p.x * p.x + q.x * q.x - p.y * p.y - q.y * q.y);
  return vec2f(cos(angle), sin(angle));
}

// Extent of the disc's image along `e`: x = P.q / (1 + C.q) on the unit disc, `rest` = 1 - |C|^2.
fn reach(e: vec2f, p: vec2f, q: vec2f, c: vec2f, rest: f32) -> vec2f {
  let along = vec2f(dot(e, p), dot(e, q));
  let pc = dot(along, c);
  let h = sqrt(pc * pc + rest * dot(along, along));
  return vec2f(-pc - h, h - pc) / rest;
}

fn hidden() -> Rectangle {
  return Rectangle(false, vec2f(0.0), vec2f(0.0), vec2f(0.0));
}
fn screen() -> Rectangle {
  return Rectangle(true, vec2f(1.0, 0.0), 0.5 * frame.size, 0.5 * frame.size);
}

// Builds the rectangle from `low` to `high` along an axis and across it, offsets from the projected centre.
fn finish(center: vec2f, axis: vec2f, low: vec2f, high: vec2f) -> Rectangle {
  let half_size = 0.5 * (high - low) * 1.0002 + BOUND_PAD;
  if !(max(half_size.x, half_size.y) < WIDEST) { return screen(); }
  let middle = 0.5 * (low + high);
  return Rectangle(true, axis, center + axis * middle.x + vec2f(-axis.y, axis.x) * middle.y, half_size);
}

// Whether the visible part of a disc lies beyond a border of the image: core/bounds.h.
fn beyond_border(along: vec2f, c: vec2f, border: f32) -> bool {
  let off = along - border * c;
  let far = abs(border);
  let room = far - 1e-5 * (abs(along.x) + abs(along.y) + far * (abs(c.x) + abs(c.y)));
  return room > 0.0 && dot(off, off) < room * room;
}

const CORNERS: u32 = 8;  // of a polygon about the disc
const MOST_CORNERS: u32 = CORNERS + 5;  // each plane adds one

// Clips a polygon around the disc to `near` and the image, and adds the low pass: for discs across the camera's plane,
// whose image is no ellipse, and for ellipses larger than the screen.
fn clipped(s: Seen, p: vec2f, q: vec2f, c: vec2f, blur: f32) -> Rectangle {
  let border = select(-s.center, min(frame.size - s.center, vec2f(0.0)), s.center >= vec2f(0.0));
  var low = vec2f(-blur);
  var high = vec2f(blur);
  var count = CORNERS;
  if beyond_border(vec2f(p.x, q.x), c, border.x) || beyond_border(vec2f(p.y, q.y), c, border.y) { count = 0; }
  var corners: array<vec3f, MOST_CORNERS>;  // offset from the centre times depth, and depth, in units of the centre's
  for (var k = 0u; k < count; k++) {
    let turn = (f32(k) + 0.5) * 6.2831853 / f32(CORNERS);
    let at = 1.0824 * vec2f(cos(turn), sin(turn));  // 1 / cos(pi / 8)
    corners[k] = vec3f(at.x * p + at.y * q, 1.0 + dot(c, at));
  }
  let planes = array<vec4f, 5>(
    vec4f(0.0, 0.0, 1.0, -frame.near / s.z),
    vec4f(1.0, 0.0, s.center.x, 0.0),
    vec4f(-1.0, 0.0, frame.size.x - s.center.x, 0.0),
    vec4f(0.0, 1.0, s.center.y, 0.0),
    vec4f(0.0, -1.0, frame.size.y - s.center.y, 0.0),
  );
  for (var side = 0u; side < 5; side++) {
    let polygon = corners;
    let before = count;
    count = 0;
    for (var k = 0u; k < before; k++) {
      let here = polygon[k];
      let next = polygon[select(k + 1, 0, k + 1 == before)];
      let inner = dot(planes[side], vec4f(here, 1.0));
      let after = dot(planes[side], vec4f(next, 1.0));
      if inner >= 0.0 {
        corners[count] = here;
        count++;
      }
      if (inner >= 0.0) != (after >= 0.0) && count < MOST_CORNERS {
        corners[count] = here + inner / (inner - after) * (next - here);
        count++;
      }
    }
  }
  if count > 0 && blur == 0.0 {  // the centre does not count
    low = vec2f(1e9);
    high = -low;
  }
  for (var k = 0u; k < count; k++) {
    let depth = corners[k].z;
    let at = corners[k].xy / depth;
    // rounding error: differences of the disc's axes, divided by a possibly small depth
    let lost = 5e-7 * (abs(p) + abs(q) + abs(at) * (abs(c.x) + abs(c.y) + 1.0)) / depth;
    low = min(low, at - 0.5 - lost);
    high = max(high, at + 0.5 + lost);
  }
  var r = finish(s.center, vec2f(1.0, 0.0), low, high);
  r.visible = count > 0 || blur > 0.0;
  return r;
}

fn rectangle(s: Seen) -> Rectangle {
  let ratio = s.opacity / ALPHA_MIN;
  let blurred = s.low_pass * ratio;  // maximum of the low pass over ALPHA_MIN
  let almost = 1.0 - 1e-6;
  if max(ratio, blurred) < almost { return hidden(); }
  let r2 = level_radius2(log(max(ratio, 1.0)) + 1e-5, s.beta);
  // if the kernel exceeds the low pass everywhere, the latter needs no extra pixels
  let blur2 = 1.0 / low_pass_sharp();
  let change = LOW_PASS_REACH * sqrt(blur2) * (abs(s.w.x) + abs(s.w.y));
  let least = s.w0 - change;
  let slope = dot(s.u, s.u) + dot(s.v, s.v);
  let covered = s.low_pass <= 1.0 && least > 0.0 && s.w0 * s.z > frame.near * (s.w0 + change)
    && SUPPORT2 * least * least >= (s.beta + LOW_PASS_REACH * LOW_PASS_REACH) * blur2 * 1.001 * slope;
  var blur = 0.0;
  if !covered && blurred >= almost { blur = sqrt((log(max(blurred, 1.0)) + 1e-5) * blur2) + 0.01; }
  if !(s.w0 > 0.0) {  // seen exactly edge-on: no ray hits it
    return finish(s.center, vec2f(1.0, 0.0), vec2f(-blur), vec2f(blur));
  }
  let mu = 1.0 / max(abs(s.u.x), abs(s.u.y));
  let mv = 1.0 / max(abs(s.v.x), abs(s.v.y));
  let u = s.u * mu;
  let v = s.v * mv;
  let det = u.x * v.y - u.y * v.x;
  if !(abs(det) > LEAST_ANGLE) { return screen(); }
  let wide = sqrt(r2) * (1.0001 + 1e-6 / abs(det)) / det;
  let p = s.w0 * mu * wide * vec2f(v.y, -v.x);
  let q = s.w0 * mv * wide * vec2f(-u.y, u.x);
  let c = vec2f(s.w.y * v.x - s.w.x * v.y, s.w.x * u.y - s.w.y * u.x) * vec2f(mu, mv) * wide;
  let rest = 1.0 - dot(c, c);
  if !(dot(p, p) + dot(q, q) < 1e12) { return screen(); }
  if !(rest > 1e-3) { return clipped(s, p, q, c, blur); }
  let axis = major_axis(p, q);
  let along = reach(axis, p, q, c, rest);
  let across = reach(vec2f(-axis.y, axis.x), p, q, c, rest);
  let low = min(vec2f(along.x, across.x), vec2f(-blur));
  let high = max(vec2f(along.y, across.y), vec2f(blur));
  let r = finish(s.center, axis, low, high);
  if max(r.half_size.x, r.half_size.y) < max(frame.size.x, frame.size.y) { return r; }
  let cut = clipped(s, p, q, c, blur);
  if !cut.visible || cut.half_size.x * cut.half_size.y < r.half_size.x * r.half_size.y { return cut; }
  return r;
}

fn on_screen(r: Rectangle) -> bool {
  let box = abs(r.axis) * r.half_size.x + abs(r.axis.yx) * r.half_size.y;
  return r.visible && all(r.middle + box >= vec2f(0.0)) && all(r.middle - box <= frame.size);
}
