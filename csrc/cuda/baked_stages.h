// Shared by the stages of the baked renderer: working memory, and a surfel's row.
#pragma once

#include "core/footprint.h"
#include "core/resize.h"
#include "cuda/baked.h"

namespace bt::cuda {

constexpr uint32_t kNeverSeen = 0xffffffffu;  // depth key of a surfel that is not visible

// A surfel's row: the first columns are those of level_row (core/footprint.h), but that kBlur2 may be kNearCuts. 24
// floats are three sectors of 32 bytes.
enum RowColumn {
  kRed = kLevelRow,        // relu(view colour + 0.5), three
  kTexelScale = kRed + 3,  // 1 / (2 extent); 0: neither residual nor alpha; -1: constant ones
  kLevel,                  // of the tile; the column after it is free
  kTileX = kLevel + 2,  // centre of the tile's first texel, two; or four: the colour with the constant residual, alpha
  kSpanX = kTileX + 2,  // texels of the tile less one, two
  kRow = kSpanX + 2
};
static_assert(kRow == 24 && kR2 == 12);
// No low pass, but pixels have to be compared with the near plane; without PixelKernel, which compares all rows that it
// does not filter.
constexpr float kNearCuts = -1;

// A screen tile's list: its first pairs are in slots of its own, the others as they come in one list of all tiles,
// where each names the one before it. Four chains, because following one is waiting for memory at every step.
constexpr int kChains = 4;
struct alignas(16) TileList {
  int32_t count;             // pairs
  int32_t listed;            // where they are more than slots: those that are listed once that is done, before that 0
  uint32_t rest;             // likewise from where on in `pairs` the list stands as a whole, but for its slots
  uint32_t long_index;       // in long_tiles plus one, 0: the list is not long
  uint32_t chains[kChains];  // the last pair's index in `spilled` plus one, 0: none
};
static_assert(sizeof(TileList) == 32);
struct alignas(8) SpilledPair {
  uint32_t pair, before;  // as in `pairs`; as in `chains`
};

struct BakedMemory {
  int64_t* total;          // pairs of surfel and tile
  int64_t* spilled_count;  // of these, those that found no slot
  int64_t* rest_count;     // of these, those that tiles have moved behind the slots
  int32_t* large_count;    // surfels of many tiles
  int32_t* long_count;     // tiles whose list is long
  TileList* lists;         // [tiles]
  int64_t cleared;         // bytes from `total` on that a frame begins with as zeros: all above
  float* rows;             // [rows, kRow]
  float4* normals;         // [rows], null: not wanted
  uint32_t* depth;         // [rows] keys in the order of depth
  uint32_t* pairs;         // [tiles * slots + capacity] row << 8 | mask
  SpilledPair* spilled;    // [capacity]
  uint32_t* large;         // [rows] surfels of many tiles
  uint32_t* long_tiles;    // [tiles] those whose list is long
};

struct BakedFrame {
  int64_t n, rows, capacity;  // surfels; surfels times views; room for pairs that find no slot
  int slots;                  // of a tile
  int long_from;              // pairs beyond which its list is long
  int width, height, tiles_x, tiles_y;
  int64_t tiles;      // of all views
  int prefilter;      // as in BakedScene
  float photo_pixel;  // as in BakedDraw
  BakedMemory memory;
};

void baked_list(const BakedScene& surfels, const BakedViews& views, const BakedFrame& frame, Stream stream);
void baked_draw(const BakedScene& surfels, const BakedImages& images, const BakedFrame& frame, Stream stream);

__device__ inline int64_t add_to(int64_t* count, int64_t more) {  // what it was before
  return int64_t(atomicAdd(reinterpret_cast<unsigned long long*>(count), static_cast<unsigned long long>(more)));
}

}  // namespace bt::cuda
