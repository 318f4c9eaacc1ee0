// Shared part of the bounds of a surfel's pixels in double (core/bounds.h) and in the reals of the fragments
// (core/plane_bounds.h): level set, padding, culling of discs out of view, and x offsets of box, ellipse and low pass
// between two lines.
#pragma once

#include "core/surfel.h"

namespace bt {

// sigma >= 1/255  <=>  u^2 + v^2 <= r_c^2 with r_c^2 = 9 (1 - (255 o)^(-1/beta)), or d^2 <= ln(255 o).
// Returns an opacity relative to the smallest drawn sigma.
template <class S> BT_HD S times_drawn(S opacity) { return S(1 / kAlphaMin) * opacity; }
// Computes the squared radius r_c^2 = 9 (1 - exp(-level / beta)) where the kernel is exp(-level) of its maximum;
// enlarged by a part in 5,000 and `slack`, so that the bound holds despite rounding.
template <class S> BT_HD S level_radius2(S level, S beta, S slack) {
  const S x = S(1) - exp_(-level / max_(beta, S(1e-6)));
  return S(kSupport2) * min_(S(1), x * S(1.0002) + slack);
}
// Computes the radius in pixels where the low pass is exp(-level).
template <class S> BT_HD S low_pass_radius(S level) { return sqrt_(level) + S(0.01); }

// Returns true where the low pass of a row, of squared radius `wide`, nowhere exceeds the kernel.
// With x = rho / 9 <= d^2 / k near the centre, k = 9 W^2 / |UV|^2 at its smallest, and log(1 - x) >= -x / (1 - x), the
// kernel (1 - x)^beta is at least exp(-d^2 / wide) out to d^2 / wide = ln 255 where k >= (beta + ln 255) wide. Up to
// there the plane must lie beyond `near`, which clips the kernel only.
template <class T> BT_HD MaskOf<T> covers_low_pass(const T* g, T near, T wide) {
  const T reach = T(kLowPassReach), change = reach * sqrt_(wide) * (abs_(g[kW1]) + abs_(g[kW2]));
  const T least = g[kW0] - change, most = g[kW0] + change, k = T(kSupport2) * least * least;
  const T slope = g[kU1] * g[kU1] + g[kU2] * g[kU2] + g[kV1] * g[kV1] + g[kV2] * g[kV2];
  return (T(1.0f) >= g[kLowPassHeight]) & (least > T(0.0f)) & (g[kW0] * g[kZ] > near * most) &
         (k >= (g[kBeta] + reach * reach) * wide * T(1.001) * slope);
}

constexpr double kBoundPad = 0.01;    // pixels added to a box
constexpr double kBoundSlack = 1e-3;  // tolerance of "between two lines", relative to an ellipse's height

template <class T> struct Interval {
  T x0 = T(1e30), x1 = T(-1e30);  // nothing
  BT_HD MaskOf<T> empty() const { return x0 > x1; }
  BT_HD void add(T low, T high) { x0 = min_(x0, low), x1 = max_(x1, high); }
  BT_HD void add_where(MaskOf<T> there, T low, T high) {
    x0 = select(there, min_(x0, low), x0), x1 = select(there, max_(x1, high), x1);
  }
};

// Image of a level set: the ellipse's box and outermost points, and the low pass's disc. Offsets from the projected
// centre in pixels.
template <class T> struct Outline {
  MaskOf<T> whole = T(0.0f) < T(0.0f);             // the disc comes near the camera plane: covers the screen
  MaskOf<T> ellipse = T(0.0f) < T(0.0f);           // false: low pass only
  T x0 = T(1), x1 = T(-1), y0 = T(1), y1 = T(-1);  // box of the ellipse
  T y_left = T(0), y_right = T(0);                 // y of its leftmost and rightmost points
  T blur = T(0);                                   // radius of the low pass; 0: none
};

// Image of the disc u^2 + v^2 <= r^2 of a row: the three planes of surfel.h solved for the pixel,
//   dx = X.q / (1 + C.q),  dy = Y.q / (1 + C.q)   with q = (u, v) / r on the unit disc,
// in front of the camera where 1 + C.q > 0. Precision is lost if the angle between the lines U = 0 and V = 0 on the
// screen is small; r is widened accordingly.
template <class T> struct DiscImage {
  T xu, xv, yu, yv, cu, cv;  // X, Y, C
  T angle;                   // sine of the angle between the two lines, up to a factor of 2
};
template <class T> BT_HD DiscImage<T> disc_image(const T* g, T r2) {
  const T mu = T(1.0f) / max_(abs_(g[kU1]), abs_(g[kU2])), mv = T(1.0f) / max_(abs_(g[kV1]), abs_(g[kV2]));
  const T u1 = g[kU1] * mu, u2 = g[kU2] * mu, v1 = g[kV1] * mv, v2 = g[kV2] * mv;  // in [-1, 1]
  const T det = u1 * v2 - u2 * v1, angle = abs_(det);
  const T inv = T(1.0f) / det;
  const T r = sqrt_(r2) * (T(1.0001) + T(1e-6) / angle);
  const T ku = g[kW0] * mu * inv * r, kv = g[kW0] * mv * inv * r;
  return {ku * v2,
          -kv * u2,
          -ku * v1,
          kv * u1,
          (g[kW2] * v1 - g[kW1] * v2) * mu * inv * r,
          (g[kW1] * u2 - g[kW2] * u1) * mv * inv * r,
          angle};
}

// Returns true where the part of a disc in front of the camera lies beyond a border of the image: the disc against the
// plane through the camera and the border. `border`: offset of the border's line from the projected centre, between the
// centre and the image; 0: the centre is not beyond it. If X.q < border (1 + C.q) on the whole disc, or >, no ray of
// the image meets it, even where it crosses the camera's plane and has no box. False for NaN.
template <class T> BT_HD MaskOf<T> beyond_border(T xu, T xv, T cu, T cv, T border) {
  const T u = xu - border * cu, v = xv - border * cv, far = abs_(border);
  const T room = far - T(1e-5) * (abs_(xu) + abs_(xv) + far * (abs_(cu) + abs_(cv)));  // less the rounding error
  return (room > T(0.0f)) & (u * u + v * v < room * room);
}
template <class T> BT_HD MaskOf<T> out_of_view(const DiscImage<T>& d, T cx, T cy, int width, int height) {
  const auto border = [](T c, int size) { return select(c < T(0.0f), -c, min_(T(double(size)) - c, T(0.0f))); };
  return (d.angle > T(1e-6)) & (beyond_border(d.xu, d.xv, d.cu, d.cv, border(cx, width)) |
                                beyond_border(d.yu, d.yv, d.cu, d.cv, border(cy, height)));
}
// Reduces discs without a box, `d`, that are out of view to their low pass.
template <class T> BT_HD void cut_to_view(const DiscImage<T>& d, T cx, T cy, int width, int height, Outline<T>& e) {
  const MaskOf<T> in_view = not_(e.whole & out_of_view(d, cx, cy, width, height));
  e.whole = e.whole & in_view, e.ellipse = e.ellipse & in_view;
}

template <class T> BT_HD Interval<T> range_of(const Outline<T>& e, T low, T high) {
  Interval<T> r;
  r.add_where(e.ellipse, low, high);
  r.add_where(e.blur > T(0.0f), -e.blur, e.blur);
  r.add_where(e.whole, T(-1e9), T(1e9));
  return r;
}
template <class T> BT_HD Interval<T> columns_of(const Outline<T>& e) { return range_of(e, e.x0, e.x1); }
template <class T> BT_HD Interval<T> rows_of(const Outline<T>& e) { return range_of(e, e.y0, e.y1); }
// AccuTile: between the lines y = lo and y = hi an ellipse reaches as far as on the lines (added by the caller), or as
// its leftmost and rightmost points if they lie between, tested with slack.
template <class T> BT_HD void add_outermost(MaskOf<T> where, const Outline<T>& e, T lo, T hi, T slack, Interval<T>& r) {
  r.add_where(where & (e.y_left >= lo - slack) & (hi + slack >= e.y_left), e.x0, e.x0);
  r.add_where(where & (e.y_right >= lo - slack) & (hi + slack >= e.y_right), e.x1, e.x1);
}
template <class T> BT_HD void add_low_pass(MaskOf<T> where, const Outline<T>& e, T lo, T hi, Interval<T>& r) {
  r.add_where(where & (e.blur > T(0.0f)) & (hi >= -e.blur) & (e.blur >= lo), -e.blur, e.blur);
}

}  // namespace bt
