// A surfel's pixels are bounded in two ways: in double (core/bounds.h), and in the reals of the fragments
// (core/plane_bounds.h). This is what both share: the level set, the padding, and which x offsets a box, an ellipse and
// the low pass have between two lines.
#pragma once

#include "core/surfel.h"

namespace bt {

// sigma >= 1/255  <=>  u^2 + v^2 <= r_c^2 with r_c^2 = 9 (1 - (255 o)^(-1/beta)), or d^2 <= ln(255 o).
// How many times the smallest drawn sigma an opacity is.
template <class S>
BT_HD S times_drawn(S opacity) {
  return S(1 / kAlphaMin) * opacity;
}
// Squared radius r_c^2 = 9 (1 - exp(-level / beta)) at which the kernel is exp(-level) of its centre; a part in 5,000
// and `slack` wider: a bound must hold in spite of rounding.
template <class S>
BT_HD S level_radius2(S level, S beta, S slack) {
  const S x = S(1) - exp_(-level / max_(beta, S(1e-6)));
  return S(kSupport2) * min_(S(1), x * S(1.0002) + slack);
}
// Radius in pixels of the disc in which the low pass is exp(-level).
template <class S>
BT_HD S low_pass_radius(S level) {
  return sqrt_(level) + S(0.01);
}

// Whether the kernel of a row is nowhere below the low pass of the squared radius `wide` and no more than its height.
// With x = rho / 9 <= d^2 / k near the centre, k = 9 W^2 / |UV|^2 at its smallest, and log(1 - x) >= -x / (1 - x), the
// kernel (1 - x)^beta is at least exp(-d^2 / wide) out to d^2 / wide = ln 255 where k >= (beta + ln 255) wide. As far
// the plane has to lie behind `near`, which cuts the kernel alone.
template <class T>
BT_HD MaskOf<T> covers_low_pass(const T* g, T near, T wide) {
  const T reach = T(kLowPassReach), change = reach * sqrt_(wide) * (abs_(g[kW1]) + abs_(g[kW2]));
  const T least = g[kW0] - change, most = g[kW0] + change, k = T(kSupport2) * least * least;
  const T slope = g[kU1] * g[kU1] + g[kU2] * g[kU2] + g[kV1] * g[kV1] + g[kV2] * g[kV2];
  return (T(1.0f) >= g[kArea]) & (least > T(0.0f)) & (g[kW0] * g[kZ] > near * most) &
         (k >= (g[kBeta] + reach * reach) * wide * T(1.001) * slope);
}

constexpr double kBoundPad = 0.01;    // pixels, by which a box is wider
constexpr double kBoundSlack = 1e-3;  // share of an ellipse by which its points count as between two lines

template <class T>
struct Interval {
  T x0 = T(1e30), x1 = T(-1e30);  // nothing
  BT_HD MaskOf<T> empty() const { return x0 > x1; }
  BT_HD void add(T low, T high) { x0 = min_(x0, low), x1 = max_(x1, high); }
  BT_HD void add_where(MaskOf<T> there, T low, T high) {
    x0 = select(there, min_(x0, low), x0), x1 = select(there, max_(x1, high), x1);
  }
};

// The image of a level set: the ellipse's box and outermost points, and the low pass's disc. Offsets from the projected
// centre in pixels.
template <class T>
struct Outline {
  MaskOf<T> whole = T(0.0f) < T(0.0f);             // the disc comes near the camera plane: anything on the screen
  MaskOf<T> ellipse = T(0.0f) < T(0.0f);           // false: the low pass alone
  T x0 = T(1), x1 = T(-1), y0 = T(1), y1 = T(-1);  // box of the ellipse
  T y_left = T(0), y_right = T(0);                 // where its leftmost and its rightmost point lie
  T blur = T(0);                                   // radius of the low pass; 0: none
};
template <class T>
BT_HD Interval<T> range_of(const Outline<T>& e, T low, T high) {
  Interval<T> r;
  r.add_where(e.ellipse, low, high);
  r.add_where(e.blur > T(0.0f), -e.blur, e.blur);
  r.add_where(e.whole, T(-1e9), T(1e9));
  return r;
}
template <class T>
BT_HD Interval<T> columns_of(const Outline<T>& e) {
  return range_of(e, e.x0, e.x1);
}
template <class T>
BT_HD Interval<T> rows_of(const Outline<T>& e) {
  return range_of(e, e.y0, e.y1);
}
// AccuTile: between the lines y = lo and y = hi an ellipse reaches as far as on the lines themselves (the caller's
// part), or as far as its leftmost and rightmost points where they lie between, which is judged generously.
template <class T>
BT_HD void add_outermost(MaskOf<T> where, const Outline<T>& e, T lo, T hi, T slack, Interval<T>& r) {
  r.add_where(where & (e.y_left >= lo - slack) & (hi + slack >= e.y_left), e.x0, e.x0);
  r.add_where(where & (e.y_right >= lo - slack) & (hi + slack >= e.y_right), e.x1, e.x1);
}
template <class T>
BT_HD void add_low_pass(MaskOf<T> where, const Outline<T>& e, T lo, T hi, Interval<T>& r) {
  r.add_where(where & (e.blur > T(0.0f)) & (hi >= -e.blur) & (e.blur >= lo), -e.blur, e.blur);
}

}  // namespace bt
