// The forward-only renderer of a baked scene on the device.
//
//   prepare   one thread per surfel: projection, level set, number of tiles; then, for the visible ones alone, the view
//             colour and the tile of the atlas. Leaves a row of 24 floats, which is all that is read later.
//   bin       surfels are sorted by depth (32-bit keys, in place of one sort of all pairs by tile and depth, whose keys
//             are three times as wide and ten times as many); each then writes its (tile, surfel) pairs at its place,
//             and a stable sort by tile alone, 16-bit keys where they fit, leaves every tile's list front to back.
//   draw      one warp per 8 x 8 pixels, two per thread, four warps per tile of 16 x 16. A pair carries the mask of the
//   8 x 4
//             parts of the tile that its surfel reaches, so a warp looks at those alone.
//
// Nothing is allocated and nothing waits: counts stay on the device, and the second sort runs over the whole capacity,
// whose unused rest has the largest key. When the pairs do not fit, `total` says how many there are; the image then
// lacks surfels and the frame is to be drawn again with more capacity.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/view_color.h"
#include "cuda/kernels.h"

namespace bt::cuda {

struct BakedSurfels {
  Surfels<float> geometry;
  int kind, terms;  // as ViewColorArrays in cpu/kernels.h: 0 sv, 1 sh, 2 sb, 3 sg
  const float *a, *b, *c;
  LeanColors<float> lean;      // in place of a, b and c where lean.base is not null
  const int32_t* tiles;        // [n, 5]: x, y, page, r_u, r_v; r_u = 0: no tile
  const float* extent;         // [n], null: kSupport everywhere
  const float* mean_residual;  // [n, 3], null: 0
  const uint64_t* pages;       // a texture per page of the atlas, null: none
  float offset, scale;         // residual = offset + scale * texel
  float weight_bound, near;
  bool through_pixel;       // chooses between the kernels of core/surfel.h
  float transmittance_min;  // a surfel that would leave a pixel less is not blended and ends it; 0: all are
};

struct BakedViews {
  int count, width, height;
  const float *viewmats, *Ks;  // [count, 16], [count, 9]
};

// What is drawn, [count, height, width, channels]; null: not wanted.
struct BakedImages {
  float *rgb, *alpha;            // 3 channels over the background, 1
  uint32_t* packed;              // the same as 8 bits per channel, red in the lowest byte
  float *beta, *depth, *normal;  // sums of w beta, w z and w n (1, 1 and 3 channels)
  int32_t* overdraw;             // blended surfels
  const float* background;       // [3], null: black
};

enum BakedStage { kPrepare = 1, kBin = 2, kDraw = 4 };

constexpr int64_t kMostRows = int64_t(1) << 24;  // surfels times views: a pair holds 24 bits of row and 8 of mask
constexpr int64_t kMostPairs = (int64_t(1) << 31) - 1024;

// Bytes of working memory. Its first 8 hold `total` after a frame, the number of pairs (int64).
size_t baked_memory(int64_t surfels, const BakedViews& views, int64_t capacity, bool normals);

// Runs the stages (sum of BakedStage) of a frame of all views; a stage needs what the ones before it left in `memory`.
void baked_frame(const BakedSurfels& surfels, const BakedViews& views, const BakedImages& images, int stages,
                 void* memory, size_t bytes, int64_t capacity, Stream stream);

}  // namespace bt::cuda
