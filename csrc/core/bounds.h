// Bounds of the pixels that a surfel can touch: the box SnugBox and the row intervals AccuTile (both Speedy-Splat,
// Hanson et al. 2025) for the level set of the Beta kernel, united with the low pass. In the offset (dx, dy) from the
// projected centre the level set u^2 + v^2 <= r_c^2 is the conic U^2 + V^2 <= r_c^2 W^2.
//
// Evaluated in double, from the (rounded) coefficients of the fragments: the determinant of a conic with axis ratio k
// loses a factor k^2, and a bound that misses a pixel leaves a hole. Used on the CPU; footprint.h serves GPUs.
#pragma once

#include "core/surfel.h"

namespace bt {

// The first part is shared with footprint.h.

// sigma >= 1/255  <=>  u^2 + v^2 <= r_c^2 with r_c^2 = 9 (1 - (255 o)^(-1/beta)), or d^2 <= ln(255 o).
// Returns an opacity relative to the smallest drawn sigma.
template <class S> BT_HD S times_drawn(S opacity) { return S(1 / kAlphaMin) * opacity; }
// Computes the squared radius r_c^2 = 9 (1 - exp(-level / beta)) where the kernel is exp(-level) of its maximum,
// enlarged by a part in 5,000 and `slack` against rounding.
template <class S> BT_HD S level_radius2(S level, S beta, S slack) {
  const S x = S(1) - exp_(-level / max_(beta, S(1e-6)));
  return S(kSupport2) * min_(S(1), x * S(1.0002) + slack);
}
template <class S> BT_HD S low_pass_radius(S level) { return sqrt_(level) + S(0.01); }

// Returns true where the low pass of a row, of squared radius `wide`, nowhere exceeds the kernel.
// With x = rho / 9 <= d^2 / k near the centre, k = 9 W^2 / |UV|^2 at its smallest, and log(1 - x) >= -x / (1 - x), the
// kernel (1 - x)^beta is at least exp(-d^2 / wide) out to d^2 / wide = ln 255 where k >= (beta + ln 255) wide. There
// the plane must lie beyond `near`, which clips the kernel only.
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

// Image of a level set, pixels from the projected centre: the ellipse's box and outermost points, the low pass's disc.
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

// Returns true where the part of a disc in front of the camera lies beyond a border of the image. `border`: offset of
// the border's line from the projected centre, between the centre and the image; 0: the centre is not beyond it. If
// X.q < border (1 + C.q) on the whole disc, or >, no ray of the image meets it, even without a box. False for NaN.
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
// Reduces discs without a box that are out of view to their low pass.
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
// its leftmost and rightmost points if they lie between.
template <class T> BT_HD void add_outermost(MaskOf<T> where, const Outline<T>& e, T lo, T hi, T slack, Interval<T>& r) {
  r.add_where(where & (e.y_left >= lo - slack) & (hi + slack >= e.y_left), e.x0, e.x0);
  r.add_where(where & (e.y_right >= lo - slack) & (hi + slack >= e.y_right), e.x1, e.x1);
}
template <class T> BT_HD void add_low_pass(MaskOf<T> where, const Outline<T>& e, T lo, T hi, Interval<T>& r) {
  r.add_where(where & (e.blur > T(0.0f)) & (hi >= -e.blur) & (e.blur >= lo), -e.blur, e.blur);
}

template <class T> struct ExtentOf : Outline<T> {
  bool visible = false;
  MaskOf<T> thin = T(0.0f) < T(0.0f);  // the conic is too flat to intersect: use the box
  T qa = T(0), qb = T(0), qc = T(0), qd = T(0), qe = T(0), qf = T(0);
  // qa x^2 + 2 qb x y + qc y^2 + 2 qd x + 2 qe y + qf <= 0
};
using Extent = ExtentOf<double>;
// Calls fn(member of a, member of b) for all numbers of two extents.
template <class A, class B, class F> BT_HD void each_number(A& a, B& b, F&& fn) {
  fn(a.x0, b.x0), fn(a.x1, b.x1), fn(a.y0, b.y0), fn(a.y1, b.y1);
  fn(a.y_left, b.y_left), fn(a.y_right, b.y_right), fn(a.blur, b.blur);
  fn(a.qa, b.qa), fn(a.qb, b.qb), fn(a.qc, b.qc), fn(a.qd, b.qd), fn(a.qe, b.qe), fn(a.qf, b.qf);
}
// Finds the leftmost and rightmost points of a conic with a box.
template <class T> BT_HD void find_outermost(ExtentOf<T>& e) {
  e.y_left = -(e.qb * e.x0 + e.qe) / e.qc, e.y_right = -(e.qb * e.x1 + e.qe) / e.qc;
}

// `room`: margin of the logarithm, 0 for doubles.
constexpr double kFloatRoom = 1e-5;
template <class T> struct Level {
  MaskOf<T> visible;
  T r2, blur;  // r_c^2; radius of the low pass
};
template <class Kernel, class T> BT_HD Level<T> level_of(const T* g, double sharp, double room) {
  const T one = T(1.0f), almost = T(1.0 - 0.1 * room), ratio = times_drawn(g[kOpacity]);
  const T blurred = Kernel::kResized ? ratio * g[kLowPassHeight] : ratio;
  Level<T> l;
  l.visible = max_(ratio, blurred) >= almost;
  const T level = log_(max_(ratio, one)) + T(room);
  l.r2 = level_radius2(level, g[kBeta], T(1e-6 + room));
  l.blur = low_pass_radius(level);
  if constexpr (Kernel::kResized)
    l.blur = select(blurred >= almost, low_pass_radius(log_(max_(blurred, one)) + T(room)) / T(sqrt_(sharp)), T(0.0f));
  return l;
}
// Computes its conic and bounding box for an image of that size.
template <class T> BT_HD ExtentOf<T> conic_extent(const T* g, T rc2, T blur, int width, int height) {
  const T zero = T(0.0f);
  const T u1 = g[kU1], u2 = g[kU2], v1 = g[kV1], v2 = g[kV2], w0 = g[kW0], w1 = g[kW1], w2 = g[kW2];
  ExtentOf<T> e;
  e.blur = blur;
  e.qa = u1 * u1 + v1 * v1 - rc2 * w1 * w1;
  e.qb = u1 * u2 + v1 * v2 - rc2 * w1 * w2;
  e.qc = u2 * u2 + v2 * v2 - rc2 * w2 * w2;
  e.qd = -rc2 * w0 * w1, e.qe = -rc2 * w0 * w2, e.qf = -rc2 * w0 * w0;
  // dual conic by the adjugate of the point conic (entries needed for the box only)
  const T c33 = e.qa * e.qc - e.qb * e.qb;
  const T c13 = e.qb * e.qe - e.qc * e.qd, c23 = e.qb * e.qd - e.qa * e.qe;
  const T c11 = e.qc * e.qf - e.qe * e.qe, c22 = e.qa * e.qf - e.qd * e.qd;
  const T scale = abs_(e.qa) * abs_(e.qc);
  const T mx = c13 / c33, my = c23 / c33;
  const T hx = sqrt_(max_(mx * mx - c11 / c33, zero)), hy = sqrt_(max_(my * my - c22 / c33, zero));
  const T pad = T(kBoundPad) + T(1e-4) * max_(hx, hy);
  e.x0 = mx - hx - pad, e.x1 = mx + hx + pad, e.y0 = my - hy - pad, e.y1 = my + hy + pad;
  // an ellipse if and only if the whole disc lies in front of the camera plane
  const MaskOf<T> before = (c33 > T(1e-13) * scale) & (e.qa > zero) & (e.qc > zero);
  const MaskOf<T> boxed = before & finite_(e.x0) & finite_(e.x1) & finite_(e.y0) & finite_(e.y1);
  const MaskOf<T> hit = w0 > zero;  // edge-on: no ray hits, only the low pass is drawn
  e.ellipse = hit & before;
  e.whole = hit & (select(boxed, zero, T(1.0f)) > zero);
  e.thin = select(c33 > T(1e-10) * scale, zero, T(1.0f)) > zero;
  if (any_(e.whole)) cut_to_view<T>(disc_image(g, rc2), g[kCx], g[kCy], width, height, e);
  return e;
}

// Level set and conic of rows, without the outermost points.
template <class T> struct LevelExtent {
  Level<T> level;
  ExtentOf<Widened<T>> conic;
};
template <class Kernel, class T>
BT_HD LevelExtent<T> level_extent(const T* g, int width, int height, double sharp, double room) {
  const Level<T> level = level_of<Kernel>(g, sharp, room);
  Widened<T> wide[kGeom];
  for (int k = kCx; k <= kW2; ++k) wide[k] = widened(g[k]);
  return {level, conic_extent(wide, widened(level.r2), widened(level.blur), width, height)};
}

// Bounds a row of geom in an image of that size.
template <class Kernel, class F> BT_HD Extent extent(const F* geom, int width, int height, double sharp = 1) {
  double g[kGeom];
  for (int i = 0; i < kGeom; ++i) g[i] = double(geom[i]);
  const Level<double> level = level_of<Kernel>(g, sharp, 0);
  if (!level.visible) return {};
  Extent e = conic_extent(g, level.r2, level.blur, width, height);
  e.visible = true;
  if (e.ellipse && !e.whole) find_outermost(e);
  return e;
}

// Returns the x offsets that the surfel can touch between the lines y = lo and y = hi.
template <class T> BT_HD Interval<T> row_interval(const ExtentOf<T>& e, T lo, T hi) {
  const T zero = T(0.0f);
  const MaskOf<T> boxed = e.whole | (e.thin & e.ellipse);
  const MaskOf<T> crossed = e.ellipse & not_(boxed) & (hi >= e.y0) & (e.y1 >= lo);
  Interval<T> r;
  if (any_(crossed)) {
    // at a line: qa x^2 + 2 (qb y + qd) x + (qc y^2 + 2 qe y + qf) = 0
    const T inverse = T(1.0f) / e.qa;
    for (int side = 0; side < 2; ++side) {
      const T y = side ? hi : lo;
      const T b = e.qb * y + e.qd, c = e.qc * y * y + T(2.0f) * e.qe * y + e.qf;
      const T disc = b * b - e.qa * c;
      const T root = sqrt_(max_(disc, zero)) * inverse, mid = -b * inverse;
      const T pad = T(2 * kBoundPad) + T(kBoundSlack) * root;
      r.add_where(crossed & (disc >= zero), mid - root - pad, mid + root + pad);
    }
    // no crossings: between the lines
    r.add_where(crossed & r.empty(), e.x0, e.x1);
    add_outermost(crossed, e, lo, hi, T(2 * kBoundPad) + T(kBoundSlack) * (e.y1 - e.y0), r);
    const Interval<T> none;
    const T x0 = max_(r.x0, e.x0), x1 = min_(r.x1, e.x1);
    const MaskOf<T> some = crossed & (x1 >= x0);
    r.x0 = select(some, x0, none.x0), r.x1 = select(some, x1, none.x1);
  }
  add_low_pass(not_(boxed), e, lo, hi, r);
  if (any_(boxed)) {
    const Interval<T> rows = rows_of(e), columns = columns_of(e);
    r.add_where(boxed & (hi >= rows.x0) & (rows.x1 >= lo), columns.x0, columns.x1);
  }
  return r;
}

// Tiles: rows first, then the columns of a row.
constexpr int kTile = 16;  // pixels along a side
BT_HD int tiles_across(int pixels) { return (pixels + kTile - 1) / kTile; }

template <class T> struct TileSpan {
  T first, last;
};
// Returns the tiles along an axis of `pixels` pixels that offsets from the centre c meet; pixel i is at i.
template <class T> BT_HD TileSpan<T> tile_span(const Interval<T>& x, T c, int pixels) {
  const T zero = T(0.0f), one = T(1.0f), size = T(double(pixels));
  const MaskOf<T> none = x.empty() | (zero > c + x.x1) | (c + x.x0 > size - one);
  const T first = floor_(max_(zero, c + x.x0) * T(1.0 / kTile));
  const T last = floor_(-floor_(-min_(size, c + x.x1)) * T(1.0 / kTile));  // rounded up to a pixel first
  return {select(none, zero, first), select(none, -one, min_(last, T(double(tiles_across(pixels) - 1))))};
}
// Returns the rows of tiles of a surfel with radii above 0, i.e. whose box meets the image.
template <class F> BT_HD TileSpan<double> tile_rows(const Extent& e, const F* geom, int height) {
  return tile_span(rows_of(e), double(geom[kCy]) - 0.5, height);
}
// Returns the tiles that a surfel meets in a row of tiles; cx, cy: projected centre.
template <class T> BT_HD TileSpan<T> tile_columns(const ExtentOf<T>& e, T cx, T cy, T row, int width) {
  const T top = row * T(double(kTile)) - (cy - T(0.5));  // pixel centre i + 0.5 has the offset i + 0.5 - c
  return tile_span(row_interval(e, top, top + T(double(kTile - 1))), cx - T(0.5), width);
}

}  // namespace bt
