// Which pixels a surfel can touch: SnugBox and AccuTile for the level set of the Beta kernel, united with the low pass.
//
// sigma >= 1/255  <=>  u^2 + v^2 <= r_c^2 with r_c^2 = 9 (1 - (255 o)^(-1/beta)), or d^2 <= ln(255 o).
// In the offset (dx, dy) from the projected centre the first is the conic U^2 + V^2 <= r_c^2 W^2.
//
// Always evaluated in double, from the same (rounded) coefficients that the fragments use: the conic of a needle with
// axis ratio k loses k^2 in its determinant, and a bound that misses a pixel is a hole in the picture.
#pragma once

#include "core/prefilter.h"

namespace bt {

struct Extent {
  using S = double;
  bool visible;
  bool whole;                // the disc crosses the camera plane: its image is no ellipse, use the whole screen
  S x0, x1, y0, y1;          // box of offsets from the projected centre, pixels
  S qa, qb, qc, qd, qe, qf;  // conic qa x^2 + 2 qb x y + qc y^2 + 2 qd x + 2 qe y + qf <= 0
  S ex0, ex1, ey0, ey1;      // box of the ellipse alone
  S blur;                    // radius of the low pass, pixels
  bool thin;                 // the conic is too flat to intersect: use the box
};

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
  return S(kSupport * kSupport) * min_(S(1), x * S(1.0002) + slack);
}

// Seen through a pixel the level set lies in the ellipse q <= r_c^2 of the largest blur and magnification that any
// pixel can have: omega <= 1 / (1 - eta), eta = the relative reach of the support in depth.
BT_HD Extent filtered_extent(const double* g) {
  using S = double;
  Extent e = {};
  const S n = g[kArea], w0 = g[kW0], c = filter_variance(g[kBeta]);
  if (!(w0 > S(0)) || !(times_drawn(g[kOpacity]) > S(1))) return e;  // exactly edge-on: nothing to see
  const S e1 = g[kW1] * g[kV2] - g[kW2] * g[kV1], e2 = g[kU1] * g[kW2] - g[kU2] * g[kW1];
  const S eta = S(kSupport) * sqrt_(e1 * e1 + e2 * e2) * n / w0 * S(1.0001);
  e.whole = !(eta < S(0.9));
  e.visible = true;
  if (e.whole) {
    e.x0 = e.y0 = S(-1e9), e.x1 = e.y1 = S(1e9);
    return e;
  }
  const S w = S(1) / (S(1) - eta), w2 = w * w * n * n;
  const S xx = w2 * (g[kU2] * g[kU2] + g[kV2] * g[kV2]) + c, yy = w2 * (g[kU1] * g[kU1] + g[kV1] * g[kV1]) + c;
  const S xy = -w2 * (g[kU1] * g[kU2] + g[kV1] * g[kV2]), area = w * w * n * w0;
  // the determinant without cancellation, and not below what rounding the coefficients leaves of it
  const S det = max_(area * area + c * (xx + yy - c), S(1e-12) * xx * yy);
  const S level = log_(times_drawn(g[kOpacity]) * area / sqrt_(det)) + S(1e-4);
  e.visible = level >= S(0);
  if (!e.visible) return e;
  const S rc2 = level_radius2(level, g[kBeta], S(1e-6));
  e.qa = yy / det, e.qb = -xy / det, e.qc = xx / det, e.qd = e.qe = S(0), e.qf = -rc2;
  const S hx = sqrt_(rc2 * xx) * S(1.0001) + S(0.01), hy = sqrt_(rc2 * yy) * S(1.0001) + S(0.01);
  e.ex0 = -hx, e.ex1 = hx, e.ey0 = -hy, e.ey1 = hy;
  e.x0 = -hx, e.x1 = hx, e.y0 = -hy, e.y1 = hy;
  e.thin = !(e.qa * e.qc - e.qb * e.qb > S(1e-10) * e.qa * e.qc);
  return e;
}

template <class Kernel, class F>
BT_HD Extent extent(const F* geom) {
  using S = double;
  S g[kGeom];
  for (int i = 0; i < kGeom; ++i) g[i] = S(geom[i]);
  if (filtered<Kernel>(g)) return filtered_extent(g);
  Extent e;
  const S ratio = times_drawn(g[kOpacity]);
  e.visible = ratio >= S(1);
  if (!e.visible) return e;
  const S level = log_(ratio);
  const S rc2 = level_radius2(level, g[kBeta], S(1e-6));
  e.blur = sqrt_(level) + S(0.01);
  const S u1 = g[kU1], u2 = g[kU2], v1 = g[kV1], v2 = g[kV2], w0 = g[kW0], w1 = g[kW1], w2 = g[kW2];
  e.qa = u1 * u1 + v1 * v1 - rc2 * w1 * w1;
  e.qb = u1 * u2 + v1 * v2 - rc2 * w1 * w2;
  e.qc = u2 * u2 + v2 * v2 - rc2 * w2 * w2;
  e.qd = -rc2 * w0 * w1, e.qe = -rc2 * w0 * w2, e.qf = -rc2 * w0 * w0;
  // dual conic by the adjugate of the point conic (entries needed for the box only)
  const S c33 = e.qa * e.qc - e.qb * e.qb;
  const S c13 = e.qb * e.qe - e.qc * e.qd, c23 = e.qb * e.qd - e.qa * e.qe;
  const S c11 = e.qc * e.qf - e.qe * e.qe, c22 = e.qa * e.qf - e.qd * e.qd;
  const S scale = (e.qa > S(0) ? e.qa : -e.qa) * (e.qc > S(0) ? e.qc : -e.qc);
  // an ellipse exactly when the whole disc lies in front of the camera plane
  const bool ellipse = c33 > S(1e-13) * scale && e.qa > S(0) && e.qc > S(0);
  e.thin = !(c33 > S(1e-10) * scale);
  e.whole = false;
  if (!(w0 > S(0))) {  // seen exactly edge-on: no ray hits it, the low pass alone is drawn
    e.ex0 = e.ey0 = S(1), e.ex1 = e.ey1 = S(-1);
    e.x0 = e.y0 = -e.blur, e.x1 = e.y1 = e.blur;
    return e;
  }
  if (!ellipse) {
    e.whole = true;
  } else {
    const S mx = c13 / c33, my = c23 / c33;
    const S hx = sqrt_(max_(mx * mx - c11 / c33, S(0))), hy = sqrt_(max_(my * my - c22 / c33, S(0)));
    e.ex0 = mx - hx, e.ex1 = mx + hx, e.ey0 = my - hy, e.ey1 = my + hy;
    const S pad = S(0.01) + S(1e-4) * max_(hx, hy);
    e.ex0 -= pad, e.ex1 += pad, e.ey0 -= pad, e.ey1 += pad;
    if (!finite_(e.ex0) || !finite_(e.ex1) || !finite_(e.ey0) || !finite_(e.ey1)) e.whole = true;
  }
  if (e.whole) {
    e.x0 = e.y0 = S(-1e9), e.x1 = e.y1 = S(1e9);
  } else {
    e.x0 = min_(e.ex0, -e.blur), e.x1 = max_(e.ex1, e.blur);
    e.y0 = min_(e.ey0, -e.blur), e.y1 = max_(e.ey1, e.blur);
  }
  return e;
}

// Interval of x offsets that the surfel can touch between the lines y = lo and y = hi (offsets); empty when x0 > x1.
BT_HD void row_interval(const Extent& e, double lo, double hi, double& x0, double& x1) {
  using S = double;
  x0 = S(1), x1 = S(-1);
  if (e.whole || (e.thin && e.ex0 <= e.ex1)) {
    if (hi >= e.y0 && lo <= e.y1) x0 = e.x0, x1 = e.x1;
    return;
  }
  if (hi >= e.ey0 && lo <= e.ey1) {
    // at a boundary line: qa x^2 + 2 (qb y + qd) x + (qc y^2 + 2 qe y + qf) = 0
    x0 = S(1e30), x1 = S(-1e30);
    for (int side = 0; side < 2; ++side) {
      const S y = side ? hi : lo;
      const S b = e.qb * y + e.qd, c = e.qc * y * y + S(2) * e.qe * y + e.qf;
      const S disc = b * b - e.qa * c;
      if (disc >= S(0)) {
        const S root = sqrt_(disc) / e.qa, mid = -b / e.qa;
        const S pad = S(0.02) + S(1e-3) * root;
        x0 = min_(x0, mid - root - pad), x1 = max_(x1, mid + root + pad);
      }
    }
    // the leftmost and rightmost points of the ellipse count when they lie between the lines, generously
    const S slack = S(0.02) + S(1e-3) * (e.ey1 - e.ey0);
    const S yl = -(e.qb * e.ex0 + e.qe) / e.qc, yr = -(e.qb * e.ex1 + e.qe) / e.qc;
    if (yl >= lo - slack && yl <= hi + slack) x0 = e.ex0;
    if (yr >= lo - slack && yr <= hi + slack) x1 = e.ex1;
    // between the lines but with no crossing of either: the ellipse lies wholly inside the slab
    if (x0 > x1) x0 = e.ex0, x1 = e.ex1;
    x0 = max_(x0, e.ex0), x1 = min_(x1, e.ex1);
  }
  if (hi >= -e.blur && lo <= e.blur) {
    const bool none = x0 > x1;
    x0 = none ? -e.blur : min_(x0, -e.blur);
    x1 = none ? e.blur : max_(x1, e.blur);
  }
}

// Which tiles: rows first, then the columns of a row.
constexpr int kTile = 16;  // pixels along a side
BT_HD int tiles_across(int pixels) { return (pixels + kTile - 1) / kTile; }

struct TileSpan {
  int first, last;  // none when first > last
};
// The surfel has radii above 0: its box meets the image.
template <class F>
BT_HD TileSpan tile_rows(const Extent& e, const F* geom, int height) {
  const double cy = double(geom[kCy]) - 0.5;  // pixel centre i + 0.5 has the offset i + 0.5 - c
  const int last = int(min_(double(height), ceil(cy + e.y1))) / kTile;
  return {int(max_(0.0, floor_(cy + e.y0))) / kTile, min_(tiles_across(height) - 1, last)};
}
template <class F>
BT_HD TileSpan tile_columns(const Extent& e, const F* geom, int row, int width) {
  const double cx = double(geom[kCx]) - 0.5, cy = double(geom[kCy]) - 0.5;
  double x0, x1;
  row_interval(e, row * kTile - cy, row * kTile + kTile - 1 - cy, x0, x1);
  if (x0 > x1 || cx + x1 < 0 || cx + x0 > width - 1) return {0, -1};
  const int last = int(min_(double(width), ceil(cx + x1))) / kTile;
  return {int(max_(0.0, floor_(cx + x0))) / kTile, min_(tiles_across(width) - 1, last)};
}
// fn(row, first, last) for every row of tiles in which the surfel can touch those from `first` to `last`.
template <class Kernel, class F, class Visit>
BT_HD void for_tile_rows(const F* geom, int width, int height, Visit&& fn) {
  const Extent e = extent<Kernel>(geom);
  const TileSpan rows = tile_rows(e, geom, height);
  for (int row = rows.first; row <= rows.last; ++row) {
    const TileSpan columns = tile_columns(e, geom, row, width);
    if (columns.first <= columns.last) fn(row, columns.first, columns.last);
  }
}

}  // namespace bt
