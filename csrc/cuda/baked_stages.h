// Working memory and surfel rows shared by the stages of the baked renderer.
#pragma once

#include "core/footprint.h"
#include "core/resize.h"
#include "cuda/baked.h"

namespace bt::cuda {

constexpr uint32_t kNeverSeen = 0xffffffffu;  // depth key of a surfel that is not visible

// A surfel's row: first the columns of level_row (core/footprint.h), where kBlur2 may be kNearCuts. 24 floats are three
// sectors of 32 bytes.
enum RowColumn {
  kRed = kLevelRow,        // relu(view colour + 0.5), three
  kTexelScale = kRed + 3,  // 1 / (2 extent); 0: neither residual nor alpha; -1: constants
  kLevel,                  // of the tile; the next column is unused
  kTileX = kLevel + 2,     // centre of the tile's first texel, two; for constants the shaded colour and alpha, four
  kSpanX = kTileX + 2,     // texels of the tile minus one, two
  kRow = kSpanX + 2
};
static_assert(kRow == 24 && kR2 == 12);
// No low pass, but pixels must be tested against the near plane.
constexpr float kNearCuts = -1;

// A screen tile's list: its first pairs are in its own slots, others in one list of all tiles, linked backwards. Four
// chains, because each step of following one waits for memory.
constexpr int kChains = 4;
struct alignas(16) TileList {
  int32_t count;             // pairs
  int32_t listed;            // pairs collected, if more than slots; 0 before
  uint32_t rest;             // offset in `pairs` of the collected pairs, minus `slots`: pair i is at rest + i
  uint32_t long_index;       // index in long_tiles plus one, 0: not long
  uint32_t chains[kChains];  // index of the last pair in `spilled` plus one, 0: none
};
static_assert(sizeof(TileList) == 32);
struct alignas(8) SpilledPair {
  uint32_t pair, before;  // entries as in `pairs` and in `chains`
};

struct BakedMemory {
  int64_t* total;          // pairs of surfel and tile
  int64_t* spilled_count;  // of these, those without a slot
  int64_t* rest_count;     // of these, those that tiles collected behind the slots
  int32_t* large_count;    // surfels with many tiles
  int32_t* long_count;     // tiles with long lists
  TileList* lists;         // [tiles]
  int64_t cleared;         // bytes from `total` that a frame clears first: all of the above
  float* rows;             // [rows, kRow]
  float4* normals;         // [rows], null: not drawn
  uint32_t* depth;         // [rows] keys in the order of depth
  uint32_t* pairs;         // [tiles * slots + capacity] row << 8 | mask
  SpilledPair* spilled;    // [capacity]
  uint32_t* large;         // [rows] surfels with many tiles
  uint32_t* long_tiles;    // [tiles] tiles with long lists
};

struct BakedFrame {
  int64_t n, rows, capacity;  // surfels; surfels times views; pairs without a slot that fit
  int slots;                  // per tile
  int long_from;              // pairs beyond which a list is long
  int width, height, tiles_x, tiles_y;
  int64_t tiles;      // of all views
  float photo_pixel;  // as in BakedDraw
  BakedMemory memory;
};

void baked_list(const BakedScene& surfels, const BakedViews& views, const BakedFrame& frame, Stream stream);
void baked_draw(const BakedScene& surfels, const BakedImages& images, const BakedFrame& frame, Stream stream);

__device__ inline int64_t add_to(int64_t* count, int64_t more) {  // returns the previous value
  return int64_t(atomicAdd(reinterpret_cast<unsigned long long*>(count), static_cast<unsigned long long>(more)));
}

}  // namespace bt::cuda
