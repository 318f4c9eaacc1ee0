// The rectangle on the screen that holds what a surfel can touch: the level set sigma = 1/255 of the kernel and that of
// the low pass. As core/plane_bounds.h, but along the axes of the surfel's own image, because a rasterizer draws any
// rectangle: a needle across the screen then costs what it covers.

struct Rectangle {
  visible: bool,
  whole: bool,  // the disc comes near the camera plane: anything on the screen
  axis: vec2f,
  middle: vec2f,
  half_size: vec2f,
}

const BOUND_PAD: f32 = 0.02;  // pixels
const WIDEST: f32 = 1e5;  // pixels, beyond which the whole screen is drawn

// Squared radius in scale units at which the kernel is exp(-level) of its centre, a little wide.
fn level_radius2(level: f32, beta: f32) -> f32 {
  return SUPPORT2 * min(1.0, (1.0 - exp(-level / max(beta, 1e-6))) * 1.0002 + 4e-6);
}

// The larger principal axis of the ellipse that is the image of the unit circle under [p q].
fn major_axis(p: vec2f, q: vec2f) -> vec2f {
  let angle = 0.5 * atan2(2.0 * (p.x * p.y + q.x * q.y), p.x * p.x + q.x * q.x - p.y * p.y - q.y * q.y);
  return vec2f(cos(angle), sin(angle));
}

// How far the image of the disc reaches along `e`: x = P.q / (1 + C.q) on the unit disc, `rest` = 1 - |C|^2.
fn reach(e: vec2f, p: vec2f, q: vec2f, c: vec2f, rest: f32) -> vec2f {
  let along = vec2f(dot(e, p), dot(e, q));
  let pc = dot(along, c);
  let h = sqrt(pc * pc + rest * dot(along, along));
  return vec2f(-pc - h, h - pc) / rest;
}

fn finish(axis: vec2f, along: vec2f, across: vec2f) -> Rectangle {
  var r: Rectangle;
  r.visible = true;
  r.axis = axis;
  r.middle = 0.5 * vec2f(along.x + along.y, across.x + across.y);
  r.half_size = 0.5 * vec2f(along.y - along.x, across.y - across.x) * 1.0002 + BOUND_PAD;
  r.whole = !(max(r.half_size.x, r.half_size.y) < WIDEST);
  return r;
}

fn rectangle(s: Seen) -> Rectangle {
  var r: Rectangle;
  let ratio = s.opacity / ALPHA_MIN;
  let blurred = -s.area * ratio;  // of the low pass
  let almost = 1.0 - 1e-6;
  if max(ratio, blurred) < almost { return r; }
  let r2 = level_radius2(log(max(ratio, 1.0)) + 1e-5, s.beta);
  // where the kernel is larger than the low pass everywhere, the low pass needs no room
  let blur2 = 1.0 / low_pass_sharp();
  let least = s.w0 - LOW_PASS_REACH * sqrt(blur2) * (abs(s.w.x) + abs(s.w.y));
  let slope = dot(s.u, s.u) + dot(s.v, s.v);
  let covered = -s.area <= 1.0 && least > 0.0
    && SUPPORT2 * least * least >= (s.beta + LOW_PASS_REACH * LOW_PASS_REACH) * blur2 * 1.001 * slope;
  var blur = 0.0;
  if !covered && blurred >= almost { blur = sqrt((log(max(blurred, 1.0)) + 1e-5) * blur2) + 0.01; }
  if !(s.w0 > 0.0) {  // seen exactly edge-on: no ray hits it
    return finish(vec2f(1.0, 0.0), vec2f(-blur, blur), vec2f(-blur, blur));
  }
  let mu = 1.0 / max(abs(s.u.x), abs(s.u.y));
  let mv = 1.0 / max(abs(s.v.x), abs(s.v.y));
  let u = s.u * mu;
  let v = s.v * mv;
  let det = u.x * v.y - u.y * v.x;
  r.visible = true;
  r.whole = true;
  if !(abs(det) > 1e-6) { return r; }
  let wide = sqrt(r2) * (1.0001 + 1e-6 / abs(det)) / det;
  let p = s.w0 * mu * wide * vec2f(v.y, -v.x);
  let q = s.w0 * mv * wide * vec2f(-u.y, u.x);
  let c = vec2f(s.w.y * v.x - s.w.x * v.y, s.w.x * u.y - s.w.y * u.x) * vec2f(mu, mv) * wide;
  let rest = 1.0 - dot(c, c);
  if !(rest > 1e-3 && dot(p, p) + dot(q, q) < 1e12) { return r; }
  let axis = major_axis(p, q);
  let along = reach(axis, p, q, c, rest);
  let across = reach(vec2f(-axis.y, axis.x), p, q, c, rest);
  return finish(
    axis,
    vec2f(min(along.x, -blur), max(along.y, blur)),
    vec2f(min(across.x, -blur), max(across.y, blur)),
  );
}

fn filter_variance(beta: f32) -> f32 {
  return PIXEL_VARIANCE * 2.0 / SUPPORT2 * (beta + 2.0);
}

// Seen through a pixel: the ellipse of the largest blur and magnification that any pixel can have (core/bounds.h).
fn filtered_rectangle(s: Seen) -> Rectangle {
  var r: Rectangle;
  let ratio = s.opacity / ALPHA_MIN;
  if !(s.w0 > 0.0) || !(ratio > 1.0) { return r; }
  let c = filter_variance(s.beta);
  let e = vec2f(s.w.x * s.v.y - s.w.y * s.v.x, s.u.x * s.w.y - s.u.y * s.w.x);
  let eta = SUPPORT * length(e) * s.area / s.w0 * 1.001;
  r.visible = true;
  r.whole = true;
  if !(eta < 0.9) { return r; }
  let w = 1.0 / (1.0 - eta);
  let p = w * s.area * vec2f(s.u.y, -s.u.x);
  let q = w * s.area * vec2f(s.v.y, -s.v.x);
  let area = w * w * s.area * s.w0;
  let det = area * area + c * (dot(p, p) + dot(q, q) + c);
  let level = log(ratio * area / sqrt(det)) + 1e-4;
  r.visible = level >= 0.0;
  if !r.visible { return r; }
  let r2 = level_radius2(level, s.beta);
  let axis = major_axis(p, q);
  let other = vec2f(-axis.y, axis.x);
  let along = sqrt(r2 * (dot(axis, p) * dot(axis, p) + dot(axis, q) * dot(axis, q) + c)) * 1.001;
  let across = sqrt(r2 * (dot(other, p) * dot(other, p) + dot(other, q) * dot(other, q) + c)) * 1.001;
  return finish(axis, vec2f(-along, along), vec2f(-across, across));
}

// Whether the rectangle meets the image.
fn on_screen(s: Seen, r: Rectangle, size: vec2f) -> bool {
  if !r.visible { return false; }
  if r.whole { return true; }
  let box = abs(r.axis) * r.half_size.x + abs(r.axis.yx) * r.half_size.y;
  let at = s.center + r.axis * r.middle.x + vec2f(-r.axis.y, r.axis.x) * r.middle.y;
  return all(at + box >= vec2f(0.0)) && all(at - box <= size);
}
