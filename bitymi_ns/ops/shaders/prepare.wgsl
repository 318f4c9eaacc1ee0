// Computes projection, view colour, bounding rectangle and sort key, one thread per surfel.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> surfels: array<Surfel>;
@group(0) @binding(3) var<storage, read_write> seen: array<Seen>;
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> order: array<u32>;
@group(0) @binding(6) var<storage, read_write> visible: atomic<u32>;

const HIDDEN: u32 = 0xffffffff;

fn to_camera(a: vec3f) -> vec3f {
  return vec3f(dot(frame.rotation[0].xyz, a), dot(frame.rotation[1].xyz, a), dot(frame.rotation[2].xyz, a));
}

fn finite(x: vec4f) -> bool {
  return all(abs(x) < vec4f(3e38));
}

@compute @workgroup_size(64)
fn prepare(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if i >= frame.surfels { return; }
  order[i] = i;
  keys[i] = HIDDEN;
  let surfel = surfels[i];
  let p = to_camera(surfel.mean - frame.center);
  if !(p.z > frame.near) { return; }

  let h = surfel.quat;  // w, x, y, z of unit length
  let t_u = vec3f(1.0 - 2.0 * (h.z * h.z + h.w * h.w), 2.0 * (h.y * h.z + h.x * h.w), 2.0 * (h.y * h.w - h.x * h.z));
  let t_v = vec3f(2.0 * (h.y * h.z - h.x * h.w), 1.0 - 2.0 * (h.y * h.y + h.w * h.w), 2.0 * (h.z * h.w + h.x * h.y));
  let t_n = vec3f(2.0 * (h.y * h.w + h.x * h.z), 2.0 * (h.z * h.w - h.x * h.y), 1.0 - 2.0 * (h.y * h.y + h.z * h.z));
  let a = to_camera(t_u);
  let b = to_camera(t_v);
  let n = to_camera(t_n);
  let np = dot(n, p);
  let turn = select(1.0, -1.0, np < 0.0);
  let iz = 1.0 / p.z;
  let inverse_focal = 1.0 / frame.lens.xy;
  let scales = exp(clamp(surfel.log_scale, vec2f(-LOG_SCALE_MAX), vec2f(LOG_SCALE_MAX)));

  var s: Seen;
  s.center = frame.lens.xy * p.xy * iz + frame.lens.zw;
  s.u = -turn * cross(p, b).xy * inverse_focal / scales.x;
  s.v = turn * cross(p, a).xy * inverse_focal / scales.y;
  s.w0 = turn * np * iz;
  s.w = turn * n.xy * inverse_focal;
  s.z = p.z;
  s.opacity = sigmoid(surfel.opacity_logit);
  s.beta = BETA_MAX * sigmoid(surfel.beta_raw);
  s.normal_z = -turn * n.z;
  s = resized(s);
  if !finite(vec4f(s.center, s.w0, s.low_pass)) || !finite(vec4f(s.opacity)) || !finite(vec4f(s.u, s.v)) { return; }

  let r = rectangle(s);
  if !on_screen(r) { return; }
  s.axis = r.axis;
  s.middle = r.middle;
  s.half_size = r.half_size;
  let direction = unit(surfel.mean - frame.color_center);
  s.level = tile_level(s, surfel);
  s.color = max(view_color(frame.kind, surfel, direction) + COLOR_BIAS, vec3f(0.0));
  seen[i] = s;
  keys[i] = bitcast<u32>(p.z);  // positive floats sort like their bits
  atomicAdd(&visible, 1u);
}
