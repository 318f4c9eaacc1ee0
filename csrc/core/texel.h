// Where a surfel coordinate falls in its atlas tile: texel i of r has its centre at u = (i + 0.5) / r * 2 e - e,
// with e the half side of a tile in scale units (eq. texel centres; e = R unless a bundle says otherwise).
#pragma once

#include "core/surfel.h"

namespace bt {

// Bilinear neighbours along one axis; coordinates are clamped to the outer texel centres.
template <class S>
struct TexelPair {
  int i0, i1;
  S fraction;  // weight of i1
};
template <class S>
BT_HD TexelPair<S> texel_pair(S u, int r, S extent) {
  const S x = clamp_((u + extent) / (S(2) * extent) * S(r) - S(0.5), S(0), S(r - 1));
  const int i = min_(int(x), r - 1);
  return {i, min_(i + 1, r - 1), x - S(i)};
}

}  // namespace bt
