// View colours f_view(d), without the offset 0.5, from a base and terms, as core/view_kinds.h.

const VIEW_SV: u32 = 0;  // reduced: b, rgb
const VIEW_SV_SITES: u32 = 1;  // all sites: site, log temperature, rgb
const VIEW_SH: u32 = 2;  // coefficients from degree 1 on: rgb
const VIEW_SB: u32 = 3;  // lobes: rgb, theta, phi, b
const VIEW_SG: u32 = 4;  // lobes: mu, log sharpness, rgb
const LOG_TAU_MAX: f32 = 16.0;
const LOG_POWER_MAX: f32 = 10.0;
const SH_C0: f32 = 0.28209479177387814;
const SH_C1: f32 = 0.4886025119029199;
const SH_C2A: f32 = 1.0925484305920792;
const SH_C2B: f32 = 0.31539156525252005;
const SH_C2C: f32 = 0.5462742152960396;
const SH_C3A: f32 = 0.5900435899266435;
const SH_C3B: f32 = 2.890611442640554;
const SH_C3C: f32 = 0.4570457994644658;
const SH_C3E: f32 = 0.3731763325901154;
const SH_C3F: f32 = 1.445305721320277;
const LOBE_SHARPNESS: f32 = 6.931471805599453;

@group(0) @binding(2) var<storage, read> terms: array<f32>;

fn term3(at: u32) -> vec3f {
  return vec3f(terms[at], terms[at + 1], terms[at + 2]);
}

fn unit(a: vec3f) -> vec3f {
  let big = max(abs(a.x), max(abs(a.y), abs(a.z)));
  if !(big > 1e-12) { return a * 1e12; }
  return normalize(a / big);
}

fn voronoi(s: Surfel, d: vec3f) -> vec3f {
  if s.terms == 0 { return s.base; }
  var top = 0.0;
  for (var k = 0u; k < s.terms; k++) { top = max(top, dot(term3(s.first_term + 6 * k), d)); }
  var total = exp(-top);
  var c = total * s.base;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 6 * k;
    let w = exp(dot(term3(at), d) - top);
    total += w;
    c += w * term3(at + 3);
  }
  return c / total;
}

fn voronoi_sites(s: Surfel, d: vec3f) -> vec3f {
  var top = -1e30;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 7 * k;
    top = max(top, exp(min(terms[at + 3], LOG_TAU_MAX)) * dot(unit(term3(at)), d));
  }
  var total = 0.0;
  var c = vec3f(0.0);
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 7 * k;
    let w = exp(exp(min(terms[at + 3], LOG_TAU_MAX)) * dot(unit(term3(at)), d) - top);
    total += w;
    c += w * term3(at + 4);
  }
  return c / total;
}

fn harmonics(s: Surfel, d: vec3f) -> vec3f {
  let x = d.x;
  let y = d.y;
  let z = d.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  let at = s.first_term;
  var c = SH_C0 * s.base;
  if s.terms >= 3 {
    c += SH_C1 * (-y * term3(at) + z * term3(at + 3) - x * term3(at + 6));
  }
  if s.terms >= 8 {
    c += SH_C2A * (x * y * term3(at + 9) - y * z * term3(at + 12) - x * z * term3(at + 18));
    c += SH_C2B * (2.0 * zz - xx - yy) * term3(at + 15) + SH_C2C * (xx - yy) * term3(at + 21);
  }
  if s.terms >= 15 {
    c += -SH_C3A * y * (3.0 * xx - yy) * term3(at + 24) + SH_C3B * x * y * z * term3(at + 27);
    c += -SH_C3C * y * (4.0 * zz - xx - yy) * term3(at + 30);
    c += SH_C3E * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * term3(at + 33);
    c += -SH_C3C * x * (4.0 * zz - xx - yy) * term3(at + 36) + SH_C3F * z * (xx - yy) * term3(at + 39);
    c += -SH_C3A * x * (xx - 3.0 * yy) * term3(at + 42);
  }
  return c;
}

fn lobe_softplus(x: vec3f) -> vec3f {
  let a = LOBE_SHARPNESS * x;
  return (max(a, vec3f(0.0)) + log(1.0 + exp(-abs(a)))) / LOBE_SHARPNESS;
}

fn beta_lobes(s: Surfel, d: vec3f) -> vec3f {
  var c = s.base;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 6 * k;
    let theta = terms[at + 3];
    let phi = terms[at + 4];
    let cosine = dot(vec3f(sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta)), d);
    let power = 4.0 * exp(min(terms[at + 5], LOG_POWER_MAX));
    if cosine > 0.0 { c += exp(power * log(cosine)) * lobe_softplus(term3(at)); }
  }
  return c;
}

fn gaussians(s: Surfel, d: vec3f) -> vec3f {
  var c = s.base;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 7 * k;
    let sharp = exp(min(terms[at + 3], LOG_TAU_MAX));
    c += exp(sharp * (dot(unit(term3(at)), d) - 1.0)) * term3(at + 4);
  }
  return c;
}

fn view_color(kind: u32, s: Surfel, d: vec3f) -> vec3f {
  switch kind {
    case VIEW_SV: { return voronoi(s, d); }
    case VIEW_SV_SITES: { return voronoi_sites(s, d); }
    case VIEW_SH: { return harmonics(s, d); }
    case VIEW_SB: { return beta_lobes(s, d); }
    default: { return gaussians(s, d); }
  }
}
