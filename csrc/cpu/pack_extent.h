// Where surfels can be seen, one in each lane of a pack.
#pragma once

#include "core/bounds.h"
#include "cpu/simd.h"

namespace bt {

struct PackExtent {
  Level<Pack<float>> level;
  ExtentOf<Pack<double>> conic;  // without its outermost points
};
// Of rows that are not seen through a pixel, column by column. Their conics are in double, as those of one surfel; the
// logarithms of their level sets are in float.
template <class Kernel>
BT_HD PackExtent pack_extent(const Pack<float>* g, int width, int height, double sharp) {
  const Level<Pack<float>> level = level_of<Kernel>(g, sharp, kFloatRoom);
  Pack<double> wide[kGeom];
  for (int k = kCx; k <= kW2; ++k) wide[k] = widened(g[k]);
  return {level, conic_extent(wide, widened(level.r2), widened(level.blur), width, height)};
}

}  // namespace bt
