// Arguments of the cosine transform of texel blocks, both ways.
#pragma once

#include <algorithm>

#include "ops/arguments.h"

namespace bt {

constexpr int kCosines = 8;       // texels along a side of the largest block
constexpr int kMostChannels = 3;  // of a texel

// All blocks of one size, and their transform, whose coefficients are integer multiples of steps.
template <class S> struct CosineBlocks {
  int64_t texels, tiles, blocks;
  int height, width, channels;  // of a block, at most kCosines each
  const S* mean;                // [tiles, channels], subtracted
  const S* step;                // [tiles]
  const S* mix;                 // [channels, channels] orthonormal transform of the channels
  const S *down, *across;       // [height, height], [width, width] cosine transforms: row k is frequency k
  const int64_t* order;         // [height * width] stored order of coefficients, k_v width + k_u
  const int64_t* tile;          // [blocks]
  const int64_t* rows;          // [blocks, height, width] rows of the texels in `values`

  template <class R> void fields(R& r) {
    r.numbers("height", height, "width", width, "channels", channels);
    if (std::min({height, width, channels}) < 1 || std::max(height, width) > kCosines || channels > kMostChannels)
      r.refuse("blocks have 1 to 8 texels along a side, of 1 to 3 channels");
    r.rows("mean", mean, tiles, channels);
    r.array("step", step, tiles);
    r.array("mix", mix, channels * channels);
    r.array("down", down, height * height);
    r.array("across", across, width * width);
    r.array("order", order, height * width);
    r.rows("tile", tile, blocks, 1);
    r.array("rows", rows, blocks * height * width);
  }
};

// Coefficients c of every block and channel that nearly minimise sum of weight (t - t(c))^2 + an L1 penalty: `rounds`
// iterations of ISTA from the plain transform.
template <class S> struct SparseCosines : CosineBlocks<S> {
  int rounds;
  S shrink;          // soft threshold relative to the step, for equal weights
  const S* values;   // [texels, channels]
  const S* weights;  // [texels], positive
  int32_t* codes;    // [height * width, blocks, channels]

  template <class R> void fields(R& r) {
    CosineBlocks<S>::fields(r);
    r.number("rounds", rounds);
    r.number("shrink", shrink);
    r.rows("values", values, this->texels, this->channels);
    r.array("weights", weights, this->texels);
    r.array("codes", codes, this->blocks * this->height * this->width * this->channels);
  }
};

// Texels t(c) of the coefficients.
template <class S> struct DecodeCosines : CosineBlocks<S> {
  const int32_t* codes;  // as in `SparseCosines`
  S* values;             // [texels, channels]; rows of other blocks are left

  template <class R> void fields(R& r) {
    CosineBlocks<S>::fields(r);
    r.array("codes", codes, this->blocks * this->height * this->width * this->channels);
    r.rows("values", values, this->texels, this->channels);
  }
};

}  // namespace bt
