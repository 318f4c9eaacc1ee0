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

constexpr double kBoundPad = 0.01;    // pixels, by which a box is wider
constexpr double kBoundSlack = 1e-3;  // share of an ellipse by which its points count as between two lines

template <class S>
struct Interval {
  S x0 = S(1e30), x1 = S(-1e30);  // nothing
  BT_HD bool empty() const { return x0 > x1; }
  BT_HD void add(S low, S high) { x0 = min_(x0, low), x1 = max_(x1, high); }
};

// The image of a level set: the ellipse's box and outermost points, and the low pass's disc. Offsets from the projected
// centre in pixels.
template <class S>
struct Outline {
  bool whole = false;                              // the disc comes near the camera plane: anything on the screen
  bool ellipse = false;                            // false: the low pass alone
  S x0 = S(1), x1 = S(-1), y0 = S(1), y1 = S(-1);  // box of the ellipse
  S y_left = S(0), y_right = S(0);                 // where its leftmost and its rightmost point lie
  S blur = S(0);                                   // radius of the low pass; 0: none
};
template <class S>
BT_HD Interval<S> columns_of(const Outline<S>& e) {
  Interval<S> r;
  if (e.whole) r.add(S(-1e9), S(1e9));
  if (!e.whole && e.ellipse) r.add(e.x0, e.x1);
  if (!e.whole && e.blur > S(0)) r.add(-e.blur, e.blur);
  return r;
}
template <class S>
BT_HD Interval<S> rows_of(const Outline<S>& e) {
  Interval<S> r;
  if (e.whole) r.add(S(-1e9), S(1e9));
  if (!e.whole && e.ellipse) r.add(e.y0, e.y1);
  if (!e.whole && e.blur > S(0)) r.add(-e.blur, e.blur);
  return r;
}
// AccuTile: between the lines y = lo and y = hi an ellipse reaches as far as on the lines themselves (the caller's
// part), or as far as its leftmost and rightmost points where they lie between, which is judged generously.
template <class S>
BT_HD void add_outermost(const Outline<S>& e, S lo, S hi, S slack, Interval<S>& r) {
  if (e.y_left >= lo - slack && e.y_left <= hi + slack) r.add(e.x0, e.x0);
  if (e.y_right >= lo - slack && e.y_right <= hi + slack) r.add(e.x1, e.x1);
}
template <class S>
BT_HD void add_low_pass(const Outline<S>& e, S lo, S hi, Interval<S>& r) {
  if (e.blur > S(0) && hi >= -e.blur && lo <= e.blur) r.add(-e.blur, e.blur);
}

}  // namespace bt
