// A surfel in a view of another size than the photographs that it was trained on.
//
// Let p be the side of a photograph's pixel in pixels of the view. What is to be seen is what the trained picture
// shows, averaged over the view's pixels. Where p < 1 a pixel averages 1 / p^2 samples of it, which lie evenly in it:
// of their places the variance along each axis is c = (1 - p^2) / 12 pixels^2. So (docs/numerics.md)
//   the scale ellipse Sigma = M^-1 M^-T, with (u, v) = M (dx, dy) at the centre, becomes Sigma + c' with
//   c' = c 2 (beta + 2) / 9, in the unit in which the kernel has the variance 1; its opacity times sqrt(det Sigma /
//   det(Sigma + c')), which keeps the total;
//   the low pass exp(-d^2 / p^2) becomes that of the squared radius p^2 + 2 c, times p^2 / (p^2 + 2 c), likewise.
// Where p > 1 the low pass is p pixels wide, as it is in an enlarged picture. At p = 1 nothing changes.
#pragma once

#include "core/surfel.h"

namespace bt {

// What a view's surfels share.
template <class S>
struct Resize {
  S variance;  // c, pixels^2
  S sharp;     // 1 / squared radius of the low pass
  S share;     // of its height that is left

  BT_HD explicit Resize(S photo_pixel)
      : variance(max_(S(0), (S(1) - photo_pixel * photo_pixel) / S(12))),
        sharp(S(1) / (photo_pixel * photo_pixel + S(2) * variance)),
        share(photo_pixel * photo_pixel * sharp) {}
};

// Changes a row of geom; kArea then holds by how much the low pass is higher than the kernel at the centre. False when
// the row is no longer finite.
template <class S>
BT_HD bool resize(const Resize<S>& to, S* g) {
  g[kArea] = to.share;
  if (to.variance == S(0) || !(g[kW0] > S(0))) return true;
  // M' = (1 + c' M M^T)^(-1/2) M: sums of positive terms
  const S c = to.variance * S(2 / kSupport2) * (g[kBeta] + S(2)), inv = S(1) / g[kW0];
  const S u1 = g[kU1] * inv, u2 = g[kU2] * inv, v1 = g[kV1] * inv, v2 = g[kV2] * inv;
  const S uu = c * (u1 * u1 + u2 * u2), uv = c * (u1 * v1 + u2 * v2), vv = c * (v1 * v1 + v2 * v2);
  const S cross = c * (u1 * v2 - u2 * v1), root = sqrt_(S(1) + uu + vv + cross * cross);  // of the determinant
  // of A = 1 + c' M M^T the square root is (A + root) / t, its inverse the adjugate of A + root over root t
  const S t = sqrt_(S(2) + uu + vv + S(2) * root), k = S(1) / (root * t);
  const S a = (S(1) + vv + root) * k, b = -uv * k, d = (S(1) + uu + root) * k;
  if (!finite_(a) || !finite_(b) || !finite_(d) || !finite_(root)) return false;
  for (int j = 0; j < 2; ++j) {
    const S u = g[kU1 + j], v = g[kV1 + j];
    g[kU1 + j] = a * u + b * v, g[kV1 + j] = b * u + d * v;
  }
  g[kOpacity] /= root;
  g[kArea] *= root;
  return true;
}

}  // namespace bt
