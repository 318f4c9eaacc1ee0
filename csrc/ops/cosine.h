// Arguments of sparse cosine coefficients of texel blocks.
#pragma once

#include <algorithm>

#include "ops/arguments.h"

namespace bt {

constexpr int kCosines = 8;  // texels along a side of the largest block

// Coefficients c of every block and channel that nearly minimise sum of weight (t - t(c))^2 + an L1 penalty, as integer
// multiples of steps: `rounds` iterations of ISTA from the plain transform.
template <class S> struct SparseCosines {
  int64_t texels, tiles, blocks;
  int height, width, channels, rounds;  // of a block, at most kCosines each
  S shrink;                             // soft threshold relative to the step, for equal weights
  const S* values;                      // [texels, channels]
  const S* weights;                     // [texels], positive
  const S* mean;                        // [tiles, channels], subtracted
  const S* step;                        // [tiles]
  const S* mix;                         // [channels, channels] orthonormal transform of the channels
  const S *down, *across;               // [height, height], [width, width] cosine transforms: row k is frequency k
  const int64_t* order;                 // [height * width] stored order of coefficients, k_v width + k_u
  const int64_t* tile;                  // [blocks]
  const int64_t* rows;                  // [blocks, height, width] of `values`
  int32_t* codes;                       // [height * width, blocks, channels]

  template <class R> void fields(R& r) {
    r.numbers("height", height, "width", width, "rounds", rounds, "channels", channels);
    r.number("shrink", shrink);
    if (std::min({height, width, channels}) < 1 || std::max(height, width) > kCosines || channels > 3)
      r.refuse("blocks have 1 to 8 texels along a side, of 1 to 3 channels");
    r.rows("values", values, texels, channels);
    r.array("weights", weights, texels);
    r.rows("mean", mean, tiles, channels);
    r.array("step", step, tiles);
    r.array("mix", mix, channels * channels);
    r.array("down", down, height * height);
    r.array("across", across, width * width);
    r.array("order", order, height * width);
    r.rows("tile", tile, blocks, 1);
    r.array("rows", rows, blocks * height * width);
    r.array("codes", codes, blocks * height * width * channels);
  }
};

}  // namespace bt
