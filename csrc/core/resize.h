// Adaptation of surfels to views of another size than the training photographs.
//
// Let p be the side of a photograph's pixel in pixels of the view. The goal is the trained picture averaged over the
// view's pixels. For p < 1 a pixel averages 1 / p^2 samples, evenly distributed in it, whose positions have the
// variance c = (1 - p^2) / 12 pixels^2 along each axis. So (docs/numerics.md)
//   the scale ellipse Sigma = M^-1 M^-T, with (u, v) = M (dx, dy) at the centre, becomes Sigma + c' with
//   c' = c 2 (beta + 2) / 9, in units where the kernel has the variance 1; its opacity is multiplied by
//   sqrt(det Sigma / det(Sigma + c')), which keeps the total;
//   the low pass exp(-d^2 / p^2) gets the squared radius p^2 + 2 c and the factor p^2 / (p^2 + 2 c), likewise.
// For p > 1 the low pass is p pixels wide, as in an enlarged picture. At p = 1 nothing changes.
#pragma once

#include "core/surfel.h"

namespace bt {

template <class S> struct Resize {
  S variance;  // c, pixels^2
  S sharp;     // 1 / squared radius of the low pass
  S share;     // factor of its height

  BT_HD explicit Resize(S photo_pixel)
      : variance(max_(S(0), (S(1) - photo_pixel * photo_pixel) / S(12))),
        sharp(S(1) / (photo_pixel * photo_pixel + S(2) * variance)),
        share(photo_pixel * photo_pixel * sharp) {}
};

// Resizes a row of geom; kLowPassHeight becomes the low pass's height over the kernel's. False if no longer finite.
template <class S, class T> BT_HD MaskOf<T> resize(const Resize<S>& to, T* g) {
  const T zero = T(0.0f), one = T(1.0f), two = T(2.0f);
  g[kLowPassHeight] = T(to.share);
  const MaskOf<T> seen = g[kW0] > zero;
  if (to.variance == S(0)) return finite_(one);
  // M' = (1 + c' M M^T)^(-1/2) M, from positive terms only
  const T c = T(to.variance * S(2 / kSupport2)) * (g[kBeta] + two), inv = one / select(seen, g[kW0], one);
  const T u1 = g[kU1] * inv, u2 = g[kU2] * inv, v1 = g[kV1] * inv, v2 = g[kV2] * inv;
  const T uu = c * (u1 * u1 + u2 * u2), uv = c * (u1 * v1 + u2 * v2), vv = c * (v1 * v1 + v2 * v2);
  const T cross = c * (u1 * v2 - u2 * v1), root = sqrt_(one + uu + vv + cross * cross);  // of the determinant
  // A = 1 + c' M M^T has the square root (A + root) / t, whose inverse is the adjugate of A + root over root t
  const T t = sqrt_(two + uu + vv + two * root), k = one / (root * t);
  const T a = (one + vv + root) * k, b = -uv * k, d = (one + uu + root) * k;
  for (int j = 0; j < 2; ++j) {
    const T u = g[kU1 + j], v = g[kV1 + j];
    g[kU1 + j] = select(seen, a * u + b * v, u), g[kV1 + j] = select(seen, b * u + d * v, v);
  }
  g[kOpacity] = select(seen, g[kOpacity] / root, g[kOpacity]);
  g[kLowPassHeight] = select(seen, g[kLowPassHeight] * root, g[kLowPassHeight]);
  return finite_(select(seen, abs_(a) + abs_(b) + abs_(d) + root, one));
}

}  // namespace bt
