// Bounds of the pixels that a surfel can touch, like bounds.h, but in the reals of the fragments, for devices with slow
// doubles. The image of the level set's disc replaces the conic: the box and crossings with a line follow from sums of
// squares, without a determinant of squared coefficients, so that thin surfels lose no precision.
#pragma once

#include "core/bounds.h"
#include "core/kernel.h"

namespace bt {

// Level set sigma = 1/255: u^2 + v^2 <= r2, or d^2 <= blur2; both slightly enlarged.
template <class S> struct LevelSet {
  bool visible;
  S r2;
  S blur2;  // 0: the low pass nowhere exceeds the kernel
};

// With ResizedKernel the low pass has the squared radius 1 / sharp and height kLowPassHeight.
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

constexpr int kBands = 4, kBandRows = kTile / kBands;  // of a tile

// A row of geom up to kBeta with its level set.
enum LevelColumn {
  kR2 = kBeta + 1,  // u^2 + v^2 <= r2
  kBlur2,  // and d^2 <= blur2; 0: no visible low pass. With ResizedKernel it also encodes the height of the low pass,
           // which falls to 1/255 at blur2
  kLevelRow
};
// Fills the row; false if nothing of the surfel is visible.
template <class Kernel, class S> BT_HD bool level_row(const S* geom, S near, S sharp, S* row) {
  for (int k = 0; k <= kBeta; ++k) row[k] = geom[k];
  const LevelSet<S> level = level_set<Kernel>(geom, near, sharp);
  row[kR2] = level.r2, row[kBlur2] = level.blur2;
  return level.visible;
}
// Bounds of the pixels that it can touch; `pad`: rounding margin of an ellipse.
template <class S> struct RowBounds {
  PlaneBounds<S> bounds;
  S pad;
};
template <class S> BT_HD RowBounds<S> row_bounds(const S* row, int width, int height) {
  return {plane_bounds(row, row[kR2], row[kBlur2], width, height),
          S(kBoundPad) + S(1e-6) * (abs_(row[kCx]) + abs_(row[kCy]))};
}

template <class S> struct Footprint : RowBounds<S> {
  S cx, cy;
  int top, bottom;  // rows of tiles, none when top > bottom
};
template <class S> BT_HD int pixel_from(S x, int most) {  // first pixel centre right of x, 0 to most
  const S i = -floor_(S(0.5) - x);
  return i > 0 ? (i < most ? int(i) : most) : 0;
}
template <class S> BT_HD int pixel_to(S x, int most) {  // last pixel centre left of x, -1 to most - 1
  const S i = floor_(x - S(0.5));
  return i < most - 1 ? (i >= 0 ? int(i) : -1) : most - 1;
}
template <class S> BT_HD Footprint<S> footprint(const S* row, int width, int height) {
  Footprint<S> f;
  static_cast<RowBounds<S>&>(f) = row_bounds(row, width, height);
  f.cx = row[kCx], f.cy = row[kCy];
  const PlaneBounds<S>& e = f.bounds;
  Interval<S> y;
  if (e.ellipse) y.add(e.y0 - f.pad, e.y1 + f.pad);
  if (e.blur > 0) y.add(-e.blur, e.blur);
  const int first = e.whole ? 0 : pixel_from(f.cy + y.x0, height),
            last = e.whole ? height - 1 : pixel_to(f.cy + y.x1, height);
  f.top = first / kTile, f.bottom = last / kTile;
  if (first > last) f.top = 0, f.bottom = -1;
  return f;
}

// Returns the columns that a footprint with a box can touch.
template <class S> BT_HD Interval<S> columns_of(const Footprint<S>& f) {
  const Interval<S> x = columns_of(f.bounds);
  const S pad = f.bounds.ellipse ? f.pad : S(0);
  return {f.cx + x.x0 - pad, f.cx + x.x1 + pad};
}

// A row of tiles: the pixels that can be touched in each band of four rows, and their tiles.
struct TileRow {
  int from[kBands], to[kBands];  // pixels, none when from > to
  int left, right;               // tiles, none when left > right
};
template <class S> BT_HD TileRow tile_row(const Footprint<S>& f, int ty, int width) {
  TileRow r;
  const PlaneBounds<S>& e = f.bounds;
  int from = width, to = -1;
  Interval<S> upper;  // crossings with the line above a band
  if (e.ellipse) add_crossings(e, ty * kTile - f.cy, upper);
  for (int band = 0; band < kBands; ++band) {
    const S lo = ty * kTile + band * kBandRows - f.cy, hi = lo + kBandRows;
    Interval<S> x;
    if (e.ellipse) {
      Interval<S> lower;
      add_crossings(e, hi, lower);
      x.add(min_(upper.x0, lower.x0), max_(upper.x1, lower.x1));
      upper = lower;
      add_outermost(true, e, lo, hi, f.pad + S(kBoundSlack) * (e.y1 - e.y0), x);
      x.x0 -= f.pad, x.x1 += f.pad;
    }
    add_low_pass(true, e, lo, hi, x);
    r.from[band] = x.empty() ? width : pixel_from(f.cx + x.x0, width);
    r.to[band] = x.empty() ? -1 : pixel_to(f.cx + x.x1, width);
    if (r.from[band] <= r.to[band]) from = min_(from, r.from[band]), to = max_(to, r.to[band]);
  }
  r.left = from / kTile, r.right = to / kTile;
  if (from > to) r.left = 0, r.right = -1;
  return r;
}
// Sets bit 2 band + half if the surfel reaches these 8 x 4 pixels of tile tx.
BT_HD uint32_t part_mask(const TileRow& r, int tx) {
  uint32_t mask = 0;
  const int x = tx * kTile, half = kTile / 2;
  for (int band = 0; band < kBands; ++band) {
    mask |= uint32_t(r.from[band] < x + half && r.to[band] >= x) << (2 * band);
    mask |= uint32_t(r.from[band] < x + 2 * half && r.to[band] >= x + half) << (2 * band + 1);
  }
  return mask;
}
// Computes the part mask of a disc without a box that crosses the camera's plane.
template <class S> BT_HD uint32_t reached_parts(const S* row, int tx, int ty) {
  constexpr S kPartWidth = kTile / 2;
  const S x = tx * kTile - row[kCx], y = ty * kTile - row[kCy];
  const S half_x = cell_half(S(0.5) * (kPartWidth - 1), row[kCx], abs_(x) + kTile),
          half_y = cell_half(S(0.5) * (kBandRows - 1), row[kCy], abs_(y) + kTile);
  uint32_t mask = 0;
  for (int part = 0; part < 2 * kBands; ++part) {
    const Reached<S> r = reached(row, x + (S(part % 2) + S(0.5)) * kPartWidth, y + (S(part / 2) + S(0.5)) * kBandRows,
                                 half_x, half_y, row[kR2], row[kBlur2]);
    mask |= uint32_t(r.support || r.centre) << part;
  }
  return mask;
}

}  // namespace bt
