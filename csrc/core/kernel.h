// Intersection of a pixel's ray with a surfel, and its coverage: the Beta kernel of eq. (beta-kernel) (Deformable Beta
// Splatting, Liu et al. 2025) with the screen-space low pass of 2D Gaussian Splatting,
// sigma = min(0.99, o max((1 - (u^2 + v^2)/9)+^beta, exp(-d^2))).
#pragma once

#include "core/blend.h"
#include "core/resize.h"

namespace bt {

template <class T> struct Fragment {
  T u, v;      // surfel coordinates in scale units; clamped to the support in the low-pass branch, 0 without a hit
  T depth;     // camera z of the hit; of the centre in the low-pass branch
  T sigma;     // effective opacity
  T low_pass;  // 1 in the low-pass branch, else 0
};

// Returns true where the low pass may be drawn.
template <class T> BT_HD MaskOf<T> near_centre(T dx, T dy) {
  return dx * dx + dy * dy < T(kLowPassReach * kLowPassReach);
}

// The planes U, V and W at a pixel. S: the surfel's scalars, T: a real for the pixels. dx, dy: offset in pixels from
// the projected centre.
template <class T> struct Planes {
  T U, V, W;
};
template <class S, class T> BT_HD Planes<T> planes(const S* g, T dx, T dy) {
  // left to right, as a chain of multiply-adds
  return {slope(g, kU1, dx, dy), slope(g, kV1, dx, dy), T(g[kW0]) + T(g[kW1]) * dx + T(g[kW2]) * dy};
}
// Tests u^2 + v^2 < r2 without a division, on either side of the camera.
template <class T> BT_HD MaskOf<T> within(const Planes<T>& p, T r2) { return p.U * p.U + p.V * p.V < r2 * p.W * p.W; }

template <class T> BT_HD MaskOf<T> within_in_front(const Planes<T>& p, T r2) {
  return p.U * p.U + p.V * p.V < r2 * p.W * abs_(p.W);
}

// Returns true where the kernel is above 0, in front of the camera or behind it.
template <class T> BT_HD MaskOf<T> in_support(const Planes<T>& p) { return within(p, T(kSupport2)); }

// Largest distance of a pixel from the middle of its cell, with the rounding error for offsets up to `largest`.
template <class S> BT_HD S cell_half(S half, S centre, S largest) { return half + S(1e-6) * (largest + abs_(centre)); }
// Masks of cells with a pixel in the kernel's level set u^2 + v^2 < r2, and in that of the low pass, d^2 < blur2. x, y:
// offset of the cell's middle from the projected centre. Conservative, with few false positives: within a cell a plane
// differs from its value in the middle by at most `spread` and the rounding error.
template <class T> struct Reached {
  MaskOf<T> support, centre;
};
template <class S, class T> BT_HD Reached<T> reached(const S* g, T x, T y, S half_x, S half_y, S r2, S blur2) {
  const T zero = T(S(0));
  const auto spread = [&](GeomColumn first) { return abs_(g[first]) * half_x + abs_(g[first + 1]) * half_y; };
  const Planes<T> p = planes(g, x, y);
  const Planes<T> nearest = {max_(abs_(p.U) - T(spread(kU1)), zero), max_(abs_(p.V) - T(spread(kV1)), zero),
                             p.W + T(spread(kW1) + S(1e-6) * abs_(g[kW0]))};
  const T dx = max_(abs_(x) - T(half_x + S(1e-3)), zero), dy = max_(abs_(y) - T(half_y + S(1e-3)), zero);
  return {within_in_front(nearest, T(r2 * S(1 + 1e-5))), dx * dx + dy * dy < T(blur2)};
}

// Returns true where the plane lies beyond the near depth, in front of the camera.
template <class S, class T> BT_HD MaskOf<T> behind_near(const S* g, S near, T W) {
  return T(g[kW0] * g[kZ]) > T(near) * W;
}

template <class T> BT_HD T inverse_(T x) { return T(1.0f) / x; }

// Intersection of a ray with a surfel's plane.
template <class T> struct Hit {
  MaskOf<T> ok;  // in front of the camera, beyond `near`
  T inv;         // 1 / W; 1 without a hit
  T u, v;        // 0 without a hit
  T rest;        // 1 - (u^2 + v^2) / 9
};
// Without kMisses, everything but `ok` is undefined (possibly NaN) where there is no hit.
template <bool kMisses = true, class S, class T> BT_HD Hit<T> hit(const S* g, S near, T dx, T dy) {
  const T zero = T(S(0)), one = T(S(1));
  const Planes<T> p = planes(g, dx, dy);
  Hit<T> h;
  h.ok = (p.W > zero) & behind_near(g, near, p.W);
  h.inv = inverse_(kMisses ? select(h.ok, p.W, one) : p.W);
  h.u = kMisses ? select(h.ok, p.U * h.inv, zero) : p.U * h.inv;
  h.v = kMisses ? select(h.ok, p.V * h.inv, zero) : p.V * h.inv;
  h.rest = one - (h.u * h.u + h.v * h.v) * T(S(1.0 / kSupport2));
  return h;
}

// Evaluates a surfel at a pixel. Without kBlur the low pass is left out, for pixels not near the centre; where sigma is
// 0 the rest is then undefined. `sharp` here and below: of ResizedKernel, 1 / squared radius of the low pass.
template <class Kernel, bool kBlur = true, class S, class T>
BT_HD Fragment<T> fragment(const S* g, S near, T dx, T dy, S sharp = S(1)) {
  const T zero = T(S(0)), one = T(S(1));
  const Hit<T> h = hit<kBlur>(g, near, dx, dy);
  const T kernel = select(h.ok & (h.rest > zero), power_(max_(h.rest, T(S(1e-30))), T(g[kBeta])), zero);
  Fragment<T> f;
  f.u = h.u, f.v = h.v, f.depth = T(g[kW0] * g[kZ]) * h.inv, f.low_pass = zero;
  T most = kernel;
  if (kBlur) {
    T blur;
    if constexpr (Kernel::kResized)
      blur = T(g[kLowPassHeight]) * exp_(-(dx * dx + dy * dy) * T(sharp));
    else
      blur = exp_(-(dx * dx + dy * dy));
    const auto low = blur > kernel;
    const T r = T(S(kSupport));
    f.u = clamp_(h.u, -r, r), f.v = clamp_(h.v, -r, r);
    f.depth = select(low, T(g[kZ]), f.depth);
    f.low_pass = select(low, one, zero);
    most = select(low, blur, kernel);
  }
  f.sigma = min_(T(S(kAlphaMax)), T(g[kOpacity]) * most);
  return f;
}

// Evaluates without low pass where within_in_front and behind_near hold.
template <class S, class T> BT_HD Fragment<T> fragment_within(const S* g, const Planes<T>& p) {
  const T inv = inverse_(p.W);
  const T rest = T(S(1)) - (p.U * p.U + p.V * p.V) * (inv * inv) * T(S(1.0 / kSupport2));
  Fragment<T> f;
  f.u = p.U * inv, f.v = p.V * inv, f.depth = T(g[kW0] * g[kZ]) * inv, f.low_pass = T(S(0));
  f.sigma = min_(T(S(kAlphaMax)), T(g[kOpacity]) * power_(max_(rest, T(S(1e-30))), T(g[kBeta])));
  return f;
}

// `blur`: whether any of the pixels drawn together is near the centre.
template <class Kernel, class S, class T>
BT_HD Fragment<T> fragment(const S* g, S near, T dx, T dy, bool blur, S sharp = S(1)) {
  return blur ? fragment<Kernel, true>(g, near, dx, dy, sharp) : fragment<Kernel, false>(g, near, dx, dy, sharp);
}

// Encodes sigma for a fragment list: negative in the low-pass branch.
template <class T> BT_HD T listed_sigma(const Fragment<T>& f) {
  return select(f.low_pass > T(0.0f), -f.sigma, f.sigma);
}

// Adds the gradients of a row of geom to d[kGeom], from those of a fragment with sigma `listed`; ddx, ddy: with respect
// to the pixel's offset. `rim` bounds 1 - x from below in the kernel's derivative, which diverges at 0 for beta < 1.
template <class S, class T>
BT_HD void fragment_vjp(const S* g, S near, S rim, T dx, T dy, T listed, T dsigma, T du, T dv, T ddepth, T* d, T& ddx,
                        T& ddy) {
  const T zero = T(S(0)), two = T(S(2));
  const Hit<T> h = hit(g, near, dx, dy);
  const T u = h.u, v = h.v, inv = h.inv, rest = h.rest, q = T(g[kW0] * g[kZ]);
  const auto low = listed < zero;
  const T sigma = abs_(listed), log_rest = log_(max_(rest, T(S(1e-30))));
  const T gs = select(sigma < T(S(kAlphaMax)), dsigma, zero);  // the clamp passes no gradient
  const T gk = gs * sigma;                                     // d sigma / d log kernel, sigma being o times the kernel
  d[kOpacity] += gk * T(S(1) / g[kOpacity]);
  const T gk3 = select(low, zero, gk);
  d[kBeta] += gk3 * log_rest;
  const T drho = -gk3 * T(g[kBeta]) / max_(rest, T(rim)) * T(S(1.0 / kSupport2));
  const T r = T(S(kSupport));
  // the clamp of the low-pass branch passes gradient only inside the support
  const T gu = select(h.ok & (u * u < r * r), du + two * u * drho, zero);
  const T gv = select(h.ok & (v * v < r * r), dv + two * v * drho, zero);
  const T gz = select(low, zero, ddepth);
  d[kZ] += select(low, ddepth, gz * inv * T(g[kW0]));
  const T dU = gu * inv, dV = gv * inv;
  const T dW = -(gu * u + gv * v + gz * q * inv) * inv;
  d[kU1] += dU * dx, d[kU2] += dU * dy;
  d[kV1] += dV * dx, d[kV2] += dV * dy;
  d[kW0] += dW + gz * inv * T(g[kZ]);
  d[kW1] += dW * dx, d[kW2] += dW * dy;
  const T blur_gradient = select(low, two * gk, zero);
  ddx = dU * T(g[kU1]) + dV * T(g[kV1]) + dW * T(g[kW1]) - blur_gradient * dx;
  ddy = dU * T(g[kU2]) + dV * T(g[kV2]) + dW * T(g[kW2]) - blur_gradient * dy;
  d[kCx] -= ddx, d[kCy] -= ddy;
}

}  // namespace bt
