// Visibility of surfels: projected, with a box that meets the image.
#pragma once

#include "core/bounds.h"
#include "core/resize.h"

namespace bt {

// Half extents of surfels without a box, in pixels, and the upper bound of others.
constexpr double kBoxless = 1e6;

// Rows of geom and frames, and half extents of the level set's box in pixels. `projected`: finite and in front of the
// camera; `seen`: and its box meets the image.
template <class T> struct Sight {
  T geom[kGeom], frame[kFrame], radii[2];
  MaskOf<T> projected, seen;
};
// Marks the visible surfels whose box meets the image.
template <class T, class E>
BT_HD void find_seen(MaskOf<T> visible, const E& extent, int width, int height, Sight<T>& s) {
  const auto columns = columns_of(extent), rows = rows_of(extent);
  const T x0 = narrowed<T>(columns.x0), x1 = narrowed<T>(columns.x1), y0 = narrowed<T>(rows.x0),
          y1 = narrowed<T>(rows.x1), zero = T(0.0f), most = T(kBoxless);
  const T cx = s.geom[kCx], cy = s.geom[kCy];
  s.seen = s.projected & visible & (x0 < x1) & (cx + x1 >= zero) & (T(width) >= cx + x0);
  s.seen = s.seen & (cy + y1 >= zero) & (T(height) >= cy + y0);
  s.radii[0] = min_(most, max_(x1, -x0)), s.radii[1] = min_(most, max_(y1, -y0));
}

// Writes the rows of surfel i, 0 if not visible. Returns false if a parameter is not finite. mark(sight): find_seen.
template <class Kernel, class S, class Mark>
BT_HD bool project_visible(const Pinhole<S>& cam, const Surfels<S>& in, int64_t i, S near, const Resize<S>& to, S* geom,
                           S* frames, S* radii, Mark&& mark) {
  Sight<S> s;
  const SurfelRow<S> row = surfel_row(in, i);
  s.projected = project(cam, row, near, s.geom, s.frame);
  if constexpr (Kernel::kResized) s.projected = s.projected && resize(to, s.geom);
  mark(s);
  for (int k = 0; k < kGeom; ++k) geom[i * kGeom + k] = s.seen ? s.geom[k] : S(0);
  for (int k = 0; k < kFrame; ++k) frames[i * kFrame + k] = s.seen ? s.frame[k] : S(0);
  for (int k = 0; k < 2; ++k) radii[2 * i + k] = s.seen ? s.radii[k] : S(0);
  return s.projected || surfel_finite(row);
}

}  // namespace bt
