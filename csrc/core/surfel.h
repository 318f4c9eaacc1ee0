// Cameras, and projected surfels with their vector-Jacobian product.
//
// Let a, b be the unit tangents, n = a x b the normal and p the centre, all in the camera frame, and r the ray
// r = (x, y, 1) of a pixel at (dx, dy) pixels from the projected centre. The ray meets the disc's plane at depth
// n.p / n.r, and
//   u = U / W,  v = V / W,  W = n.r = n.p/z + n.x dx/fx + n.y dy/fy,
//   U = -((p x b).x dx/fx + (p x b).y dy/fy) / s_u,   V = ((p x a).x dx/fx + (p x a).y dy/fy) / s_v.
// This is the solution of the homography of 2D Gaussian Splatting (Huang et al. 2024) divided by fx fy s_u s_v. No
// coefficient is a difference of large numbers, as the principal point cancels and n comes from the rotation instead of
// a determinant; float32 suffices. All are multiplied by the sign of n.p, so that W > 0 means "in front".
#pragma once

#include "core/common.h"

namespace bt {

// World to camera: x_cam = R x + t; pinhole in pixels.
template <class S> struct Pinhole {
  S R[9], t[3];  // row major
  S fx, fy, cx, cy;
};
template <class S> BT_HD Pinhole<S> pinhole(const S* viewmat, const S* K) {
  Pinhole<S> c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.R[3 * i + j] = viewmat[4 * i + j];
    c.t[i] = viewmat[4 * i + 3];
  }
  c.fx = K[0], c.fy = K[4], c.cx = K[2], c.cy = K[5];
  return c;
}
template <class S, class T> BT_HD Vec3<T> rotate(const S* R, Vec3<T> a) {
  return {T(R[0]) * a.x + T(R[1]) * a.y + T(R[2]) * a.z, T(R[3]) * a.x + T(R[4]) * a.y + T(R[5]) * a.z,
          T(R[6]) * a.x + T(R[7]) * a.y + T(R[8]) * a.z};
}
// Transforms a world point to the camera, in double: far from the origin R m and t cancel.
template <class S, class T> BT_HD Vec3<T> to_camera(const Pinhole<S>& cam, Vec3<T> m) {
  using D = Widened<T>;
  const D x = widened(m.x), y = widened(m.y), z = widened(m.z);
  const S *R = cam.R, *t = cam.t;
  const auto row = [&](int k) {
    const D sum = D(double(R[3 * k])) * x + D(double(R[3 * k + 1])) * y + D(double(R[3 * k + 2])) * z + D(double(t[k]));
    return narrowed<T>(sum);
  };
  return {row(0), row(1), row(2)};
}
template <class S> BT_HD Vec3<S> rotate_transposed(const S* R, Vec3<S> a) {
  return {R[0] * a.x + R[3] * a.y + R[6] * a.z, R[1] * a.x + R[4] * a.y + R[7] * a.z,
          R[2] * a.x + R[5] * a.y + R[8] * a.z};
}
// Computes the camera's centre in the world, -R^T t.
template <class S> BT_HD void camera_center(const S* viewmat, double* center) {
  const S* m = viewmat;
  for (int k = 0; k < 3; ++k) center[k] = -(double(m[k]) * m[3] + double(m[4 + k]) * m[7] + double(m[8 + k]) * m[11]);
}
// Returns the sampling position of pixel i of a row or column, in pixels.
template <class S> BT_HD S pixel_centre(int i) { return S(i) + S(0.5); }

constexpr double kSupport = 3.0;  // R: radius of the kernel in scale units
constexpr double kSupport2 = kSupport * kSupport;
constexpr double kAlphaMax = 0.99;          // upper bound of sigma
constexpr double kAlphaMin = 1.0 / 255;     // fragments of smaller sigma are skipped
constexpr double kTransmittanceMin = 1e-4;  // a pixel ends before the fragment that would leave less
constexpr double kLowPassReach = 2.36;      // pixels, > sqrt(ln(1 / kAlphaMin)): the low pass is below kAlphaMin beyond
constexpr double kBetaMax = 4.0;
constexpr double kLogScaleMax = 30.0;  // log scales are clamped to +-30: their squares stay finite in float32

// Columns of a row of `geom` [N, kGeom].
enum GeomColumn { kCx, kCy, kU1, kU2, kV1, kV2, kW0, kW1, kW2, kZ, kOpacity, kBeta, kNx, kNy, kNz, kGeom = 16 };
// Last column: ResizedKernel's height of the low pass over that of the kernel (core/resize.h); LowPassKernel: 0.
constexpr GeomColumn kLowPassHeight = GeomColumn(kGeom - 1);
// Columns of a row of `frames` [N, kFrame]: mean, s_u t_u, s_v t_v, all in the world frame.
constexpr int kFrame = 9;

// Kernels, chosen by with_kernel. LowPassKernel: the maximum of the Beta kernel and the low pass (core/kernel.h).
// ResizedKernel: the same in a view of another size than the photographs, for the baked renderers.
struct LowPassKernel {
  static constexpr bool kResized = false;
};
struct ResizedKernel {
  static constexpr bool kResized = true;
};
// photo_pixel: side of a photograph's pixel in pixels of the view.
template <class F> void with_kernel(float photo_pixel, F&& launch) {
  photo_pixel != 1 ? launch(ResizedKernel()) : launch(LowPassKernel());
}

// Evaluates a plane without its constant: U is slope(g, kU1, ...), W is g[kW0] + slope(g, kW1, ...).
template <class S, class T> BT_HD T slope(const S* g, GeomColumn first, T dx, T dy) {
  return T(g[first]) * dx + T(g[first + 1]) * dy;
}

// Parameters of a surfel's geometry and their numbers, as `ops.parameters.GEOMETRY_PARAMETERS` in Python.
#define BT_GEOMETRY(each) each(means, 3) each(quats, 4) each(log_scales, 2) each(opacity_logits, 1) each(beta_raw, 1)

template <class S> struct Surfels {
  int64_t n;
#define BT_EACH(name, count) const S* name;
  BT_GEOMETRY(BT_EACH)
#undef BT_EACH

  template <class R>  // as in ops/arguments.h
  void fields(R& r) {
    r.rows("means", means, n, 3);
#define BT_EACH(name, count) r.array(#name, name, count* n);
    BT_GEOMETRY(BT_EACH)
#undef BT_EACH
  }
};
template <class S> struct SurfelGradients {
#define BT_EACH(name, count) S* name;
  BT_GEOMETRY(BT_EACH)
#undef BT_EACH

  template <class R> void fields(R& r, int64_t n) {
#define BT_EACH(name, count) r.array("d" #name, name, count* n);
    BT_GEOMETRY(BT_EACH)
#undef BT_EACH
  }
};

// One surfel, or one per lane.
template <class T> struct SurfelRow {
#define BT_EACH(name, count) T name[count];
  BT_GEOMETRY(BT_EACH)
#undef BT_EACH
};
template <class S> BT_HD SurfelRow<S> surfel_row(const Surfels<S>& in, int64_t i) {
  SurfelRow<S> row;
#define BT_EACH(name, count) \
  for (int k = 0; k < count; ++k) row.name[k] = in.name[count * i + k];
  BT_GEOMETRY(BT_EACH)
#undef BT_EACH
  return row;
}
template <class T> BT_HD MaskOf<T> surfel_finite(const SurfelRow<T>& row) {
  MaskOf<T> finite = finite_(row.means[0]);
#define BT_EACH(name, count) \
  for (const T& number : row.name) finite = finite & finite_(number);
  BT_GEOMETRY(BT_EACH)
#undef BT_EACH
  return finite;
}

// Rotation matrix columns of a quaternion wxyz of any length.
template <class T> struct Rotation {
  Vec3<T> tu, tv, n;
  T w, x, y, z;  // the unit quaternion
  T inv;         // 1 / |q|
  MaskOf<T> ok;
};
template <class T> BT_HD Rotation<T> rotation(const T* q) {
  const T zero = T(0.0f), one = T(1.0f), two = T(2.0f);
  Rotation<T> r;
  T big = zero;
  for (int i = 0; i < 4; ++i) big = max_(big, abs_(q[i]));
  r.ok = (big > zero) & finite_(big);
  const T scale = select(r.ok, one / select(r.ok, big, one), zero);
  const T a = q[0] * scale, b = q[1] * scale, c = q[2] * scale, d = q[3] * scale;
  const T length = sqrt_(a * a + b * b + c * c + d * d);
  const T k = select(r.ok, one / select(r.ok, length, one), zero);
  r.inv = k * scale;
  r.w = select(r.ok, a * k, one), r.x = b * k, r.y = c * k, r.z = d * k;
  const T w = r.w, x = r.x, y = r.y, z = r.z;
  r.tu = {one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)};
  r.tv = {two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)};
  r.n = {two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)};
  return r;
}
template <class S> BT_HD void rotation_vjp(const Rotation<S>& r, Vec3<S> du, Vec3<S> dv, Vec3<S> dn, S* dq) {
  const S w = r.w, x = r.x, y = r.y, z = r.z, two = S(2);
  const S gw = two * (z * du.y - y * du.z - z * dv.x + x * dv.z + y * dn.x - x * dn.y);
  const S gx =
      two * (y * du.y + z * du.z + y * dv.x - two * x * dv.y + w * dv.z + z * dn.x - w * dn.y - two * x * dn.z);
  const S gy =
      two * (-two * y * du.x + x * du.y - w * du.z + x * dv.x + z * dv.z + w * dn.x + z * dn.y - two * y * dn.z);
  const S gz =
      two * (-two * z * du.x + w * du.y + x * du.z - w * dv.x - two * z * dv.y + y * dv.z + x * dn.x + y * dn.y);
  const S along = gw * w + gx * x + gy * y + gz * z;  // the length of q does not matter
  dq[0] = (gw - along * w) * r.inv, dq[1] = (gx - along * x) * r.inv;
  dq[2] = (gy - along * y) * r.inv, dq[3] = (gz - along * z) * r.inv;
}

// Computes s = exp of the clamped log scale; ds/dlog is s, 0 outside of the range.
template <class T> BT_HD T surfel_scale(T log_scale) {
  return exp_(clamp_(log_scale, T(-kLogScaleMax), T(kLogScaleMax)));
}
template <class S> BT_HD bool scale_moves(S log_scale) {
  return log_scale > S(-kLogScaleMax) && log_scale < S(kLogScaleMax);
}

// A surfel in the world, with its centre in the camera frame.
template <class T> struct WorldSurfel {
  Rotation<T> rot;
  T su, sv;  // scales
  Vec3<T> p;
};
template <class S, class T> BT_HD WorldSurfel<T> world_surfel(const Pinhole<S>& cam, const SurfelRow<T>& in) {
  return {rotation(in.quats), surfel_scale(in.log_scales[0]), surfel_scale(in.log_scales[1]),
          to_camera(cam, load3(in.means))};
}
template <class S, class T> struct CameraSurfel {
  Vec3<T> a, b, n;
  T np, sign, iz, isu, isv;
  S ifx, ify;
};
template <class S, class T> BT_HD CameraSurfel<S, T> camera_surfel(const Pinhole<S>& cam, const WorldSurfel<T>& at) {
  const T one = T(1.0f);
  CameraSurfel<S, T> s;
  s.a = rotate(cam.R, at.rot.tu), s.b = rotate(cam.R, at.rot.tv), s.n = rotate(cam.R, at.rot.n);
  s.np = dot(s.n, at.p);
  s.sign = select(s.np < T(0.0f), -one, one);
  s.iz = one / at.p.z, s.isu = one / at.su, s.isv = one / at.sv;
  s.ifx = S(1) / cam.fx, s.ify = S(1) / cam.fy;
  return s;
}

// Fills a row of geom and of frames; false, with undefined rows, if not finite or the centre is nearer than `near`.
template <class S, class T>
BT_HD MaskOf<T> project(const Pinhole<S>& cam, const SurfelRow<T>& in, S near, T* g, T* frame) {
  const WorldSurfel<T> at = world_surfel(cam, in);
  const auto& [rot, su, sv, p] = at;
  const auto [a, b, n, np, sign, iz, isu, isv, ifx, ify] = camera_surfel(cam, at);
  const Vec3<T> pa = cross(p, a), pb = cross(p, b);
  g[kCx] = T(cam.fx) * p.x * iz + T(cam.cx);
  g[kCy] = T(cam.fy) * p.y * iz + T(cam.cy);
  g[kU1] = -sign * pb.x * T(ifx) * isu, g[kU2] = -sign * pb.y * T(ify) * isu;
  g[kV1] = sign * pa.x * T(ifx) * isv, g[kV2] = sign * pa.y * T(ify) * isv;
  g[kW0] = sign * np * iz, g[kW1] = sign * n.x * T(ifx), g[kW2] = sign * n.y * T(ify);
  g[kZ] = p.z;
  g[kOpacity] = sigmoid(in.opacity_logits[0]);
  g[kBeta] = T(kBetaMax) * sigmoid(in.beta_raw[0]);
  g[kNx] = -sign * n.x, g[kNy] = -sign * n.y, g[kNz] = -sign * n.z;
  g[kLowPassHeight] = T(0.0f);
  MaskOf<T> ok = rot.ok & surfel_finite(in) & finite_(p.x) & finite_(p.y) & (p.z > T(near));
  for (int i = 0; i < kGeom; ++i) ok = ok & finite_(g[i]);
  const Vec3<T> tu = su * rot.tu, tv = sv * rot.tv;
  const T f[kFrame] = {in.means[0], in.means[1], in.means[2], tu.x, tu.y, tu.z, tv.x, tv.y, tv.z};
  for (int i = 0; i < kFrame; ++i) frame[i] = f[i];
  return ok;
}

// Writes the gradients of the parameters of surfel i from those of its rows; 0 if not visible. dframe may be null
// (zero). The slope of a sigmoid is sigmoid(x) sigmoid(-x), as 1 - o vanishes in float32 for o -> 1.
template <class S>
BT_HD void project_vjp(const Pinhole<S>& cam, const Surfels<S>& in, int64_t i, const S* geom, const S* dgeom,
                       const S* dframe, const SurfelGradients<S>& out) {
  if (geom[kZ] == S(0)) {
#define BT_EACH(name, count) \
  for (int k = 0; k < count; ++k) out.name[count * i + k] = S(0);
    BT_GEOMETRY(BT_EACH)
#undef BT_EACH
    return;
  }
  const S none[kFrame] = {};
  if (!dframe) dframe = none;
  const S* log_scales = in.log_scales + 2 * i;
  S* dlog_scales = out.log_scales + 2 * i;
  const WorldSurfel<S> at = world_surfel(cam, surfel_row(in, i));
  const auto& [rot, su, sv, p] = at;
  const auto [a, b, n, np, sign, iz, isu, isv, ifx, ify] = camera_surfel(cam, at);

  const Vec3<S> dpb = {-sign * ifx * isu * dgeom[kU1], -sign * ify * isu * dgeom[kU2], S(0)};
  const Vec3<S> dpa = {sign * ifx * isv * dgeom[kV1], sign * ify * isv * dgeom[kV2], S(0)};
  const S dnp = sign * iz * dgeom[kW0];
  Vec3<S> dn = {sign * ifx * dgeom[kW1] - sign * dgeom[kNx], sign * ify * dgeom[kW2] - sign * dgeom[kNy],
                -sign * dgeom[kNz]};
  dn = dn + dnp * p;
  // d(p x b): dp += b x d, db += d x p
  Vec3<S> dp = cross(b, dpb) + cross(a, dpa) + dnp * n;
  const Vec3<S> db = cross(dpb, p), da = cross(dpa, p);
  dp.x += cam.fx * iz * dgeom[kCx];
  dp.y += cam.fy * iz * dgeom[kCy];
  dp.z += dgeom[kZ] - iz * (dgeom[kW0] * geom[kW0] + iz * (cam.fx * p.x * dgeom[kCx] + cam.fy * p.y * dgeom[kCy]));

  const Vec3<S> dmean = rotate_transposed(cam.R, dp) + load3(dframe);
  const Vec3<S> dtu = load3(dframe + 3), dtv = load3(dframe + 6);
  const Vec3<S> gu = rotate_transposed(cam.R, da) + su * dtu;
  const Vec3<S> gv = rotate_transposed(cam.R, db) + sv * dtv;
  // u1, u2 scale with 1/s_u and the frame with s_u
  const S gsu = -(dgeom[kU1] * geom[kU1] + dgeom[kU2] * geom[kU2]) + su * dot(dtu, rot.tu);
  const S gsv = -(dgeom[kV1] * geom[kV1] + dgeom[kV2] * geom[kV2]) + sv * dot(dtv, rot.tv);
  const S dopacity = dgeom[kOpacity] * geom[kOpacity], dbeta = dgeom[kBeta] * geom[kBeta];
  store3(out.means + 3 * i, dmean);
  rotation_vjp(rot, gu, gv, rotate_transposed(cam.R, dn), out.quats + 4 * i);
  dlog_scales[0] = scale_moves(log_scales[0]) ? gsu : S(0);
  dlog_scales[1] = scale_moves(log_scales[1]) ? gsv : S(0);
  out.opacity_logits[i] = dopacity * sigmoid(-in.opacity_logits[i]);
  out.beta_raw[i] = dbeta * sigmoid(-in.beta_raw[i]);
}

}  // namespace bt
