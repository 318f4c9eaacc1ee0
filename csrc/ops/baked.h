// What the renderers of a baked scene take on both devices.
#pragma once

#include "ops/arguments.h"

namespace bt {

// Channels of a baked image of the CPU: rgb, alpha; with maps those of CompositeForward.
constexpr int kBakedChannels = 4;

// How texels change the colours of n surfels.
struct BakedResidual {
  float offset, scale;         // residual = offset + scale * stored
  const float* extent;         // [n] half side of the tile, scale units; null: kSupport everywhere
  const float* mean_residual;  // [n, 3], the residual of a surfel without a tile; null: 0
  float weight_bound;          // fragments of smaller weight get no residual
  float transmittance_min;     // a surfel that would leave a pixel less ends it, see blend_test; 0: none does

  template <class R>
  void fields(R& r, int64_t n) {
    r.number("offset", offset);
    r.number("scale", scale);
    r.maybe("extent", extent, n);
    r.maybe("mean_residual", mean_residual, 3 * n);
    r.number("weight_bound", weight_bound);
    r.number("transmittance_min", transmittance_min);
  }
};

}  // namespace bt
