// Which surfels a camera sees: projected, and with a box that meets the image.
#pragma once

#include "core/bounds.h"
#include "core/resize.h"

namespace bt {

template <class S>
BT_HD bool surfel_finite(const Surfels<S>& in, int64_t i) {
  bool finite = finite_(in.opacity_logits[i]) && finite_(in.beta_raw[i]);
  for (int k = 0; k < 3; ++k) finite &= finite_(in.means[3 * i + k]);
  for (int k = 0; k < 4; ++k) finite &= finite_(in.quats[4 * i + k]);
  for (int k = 0; k < 2; ++k) finite &= finite_(in.log_scales[2 * i + k]);
  return finite;
}

// Rows of surfel i in geom, frames and radii (half extents of the level set's box in pixels); all 0 where the camera
// does not see it. False when that is because a parameter is not finite.
template <class Kernel, class S>
BT_HD bool project_visible(const Pinhole<S>& cam, int width, int height, const Surfels<S>& in, int64_t i, S near,
                           const Resize<S>& to, S* geom, S* frames, S* radii) {
  S g[kGeom], f[kFrame], r[2] = {S(0), S(0)};
  bool projected = project<Kernel>(cam, in, i, near, g, f);
  if constexpr (Kernel::kResized) projected = projected && resize(to, g);
  bool seen = projected;
  if (projected) {
    const Extent e = extent<Kernel>(g, double(to.sharp));
    const Interval<double> x = columns_of(e), y = rows_of(e);
    seen = e.visible && g[kCx] + x.x1 >= 0 && g[kCx] + x.x0 <= width && g[kCy] + y.x1 >= 0 && g[kCy] + y.x0 <= height;
    const double most = 1e6;
    if (seen) r[0] = S(min_(most, max_(x.x1, -x.x0))), r[1] = S(min_(most, max_(y.x1, -y.x0)));
  }
  for (int k = 0; k < kGeom; ++k) geom[i * kGeom + k] = seen ? g[k] : S(0);
  for (int k = 0; k < kFrame; ++k) frames[i * kFrame + k] = seen ? f[k] : S(0);
  radii[2 * i] = r[0], radii[2 * i + 1] = r[1];
  return projected || surfel_finite(in, i);
}

}  // namespace bt
