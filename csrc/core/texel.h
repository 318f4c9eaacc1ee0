// Where a surfel coordinate falls in its atlas tile: texel i of r has its centre at u = (i + 0.5) / r * 2 e - e,
// with e the half side of the surfel's tile in scale units (eq. texel centres).
#pragma once

#include "core/surfel.h"

namespace bt {

// Position along one axis of a tile of r texels, clamped to the outer texel centres: texel floor(x), its neighbour
// min(floor(x) + 1, r - 1), and the fraction is the neighbour's weight.
template <class S, class T>
BT_HD T texel_position(T u, int r, S extent) {
  const T x = (u + T(extent)) * T(S(r) / (S(2) * extent)) - T(S(0.5));
  return clamp_(x, T(S(0)), T(S(r - 1)));
}

// The same for a tile of span + 1 texels, with k = 1 / (2 extent) at hand.
template <class S, class T>
BT_HD T texel_position_scaled(T u, S span, S k) {
  return clamp_(u * T((span + S(1)) * k) + T(S(0.5) * span), T(S(0)), T(span));
}

// Surfel coordinate of the centre of texel i, eq. (texel centres).
template <class S>
BT_HD S texel_centre(int i, int r, S extent) {
  return (S(i) + S(0.5)) * (S(2) * extent / S(r)) - extent;
}

}  // namespace bt
