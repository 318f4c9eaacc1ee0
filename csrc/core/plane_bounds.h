// Bounds of the pixels that a surfel can touch, like bounds.h, but in the reals of the fragments, for devices with slow
// doubles. It uses the image of the level set's disc (outline.h) instead of a conic: the box and crossings with a line
// follow from sums of squares, without a determinant of squared coefficients, so that thin surfels lose no precision.
#pragma once

#include "core/bounds.h"

namespace bt {

// Level set sigma = 1/255: u^2 + v^2 <= r2, or d^2 <= blur2; both slightly enlarged.
template <class S> struct LevelSet {
  bool visible;
  S r2;
  S blur2;  // 0: the low pass nowhere exceeds the kernel
};

// Computes that of a row; with ResizedKernel the low pass has the squared radius 1 / sharp and height kLowPassHeight.
template <class Kernel, class S> BT_HD LevelSet<S> level_set(const S* g, S near, S sharp) {
  LevelSet<S> l = {false, S(0), S(0)};
  const S ratio = times_drawn(g[kOpacity]), almost = S(1) - S(1e-6);
  const S blurred = Kernel::kResized ? ratio * g[kLowPassHeight] : ratio, wide = Kernel::kResized ? S(1) / sharp : S(1);
  l.visible = max_(ratio, blurred) >= almost;
  if (!l.visible) return l;
  l.r2 = level_radius2(log_(max_(ratio, S(1))) + S(1e-5), g[kBeta], S(4e-6));
  if (!(blurred >= almost)) return l;
  l.blur2 = covers_low_pass(g, near, wide) ? S(0) : (log_(max_(blurred, S(1))) + S(1e-5)) * wide;
  return l;
}

template <class S> struct PlaneBounds : Outline<S>, DiscImage<S> {};

// Computes box and outermost points from X, Y and C.
template <class S> BT_HD void bounding_box(PlaneBounds<S>& e) {
  const S cc = e.cu * e.cu + e.cv * e.cv, rest = S(1) - cc;
  const S xx = e.xu * e.xu + e.xv * e.xv, yy = e.yu * e.yu + e.yv * e.yv;
  e.whole = !(rest > S(1e-3) && xx < S(1e16) && yy < S(1e16));  // also for NaN
  if (e.whole) return;
  // a line x = const touches the image of the disc where |X - x C| = |x|
  const S xc = e.xu * e.cu + e.xv * e.cv, yc = e.yu * e.cu + e.yv * e.cv;
  const S hx = sqrt_(xc * xc + rest * xx), hy = sqrt_(yc * yc + rest * yy);
  e.x0 = (-xc - hx) / rest, e.x1 = (hx - xc) / rest;
  e.y0 = (-yc - hy) / rest, e.y1 = (hy - yc) / rest;
  for (int side = 0; side < 2; ++side) {
    const S x = side ? e.x1 : e.x0;
    const bool point = x == S(0);
    const S k = S(1) / select(point, S(1), x);
    const S qu = select(point, S(0), k * (e.xu - x * e.cu)), qv = select(point, S(0), k * (e.xv - x * e.cv));
    const S y = (e.yu * qu + e.yv * qv) / (S(1) + e.cu * qu + e.cv * qv);
    (side ? e.y_right : e.y_left) = y;
  }
}

// Bounds a row with r2 and blur2 of level_set, for an image of that size.
template <class S> BT_HD PlaneBounds<S> plane_bounds(const S* g, S r2, S blur2, int width, int height) {
  PlaneBounds<S> e = {};
  if (blur2 > S(0)) e.blur = low_pass_radius(blur2);
  if (!(g[kW0] > S(0))) return e;  // edge-on: no ray hits
  e.ellipse = true;
  static_cast<DiscImage<S>&>(e) = disc_image(g, r2);
  bounding_box(e);
  e.whole = e.whole || !(e.angle > S(1e-6));
  if (e.whole) cut_to_view<S>(e, g[kCx], g[kCy], width, height, e);
  return e;
}

// Adds the crossings of the line y with the ellipse.
template <class S> BT_HD void add_crossings(const PlaneBounds<S>& e, S y, Interval<S>& r) {
  const S mu = e.yu - y * e.cu, mv = e.yv - y * e.cv, mm = mu * mu + mv * mv;
  if (!(mm > S(0)) || !(y * y <= mm)) return;
  const S k = S(1) / mm, at = y * k, half = sqrt_(max_(S(1) - y * at, S(0)) * k);
  for (int side = 0; side < 2; ++side) {
    const S h = side ? half : -half;
    const S qu = at * mu - h * mv, qv = at * mv + h * mu;
    const S x = (e.xu * qu + e.xv * qv) / (S(1) + e.cu * qu + e.cv * qv);
    r.add(x, x);
  }
}

}  // namespace bt
