// A tile is 16 blocks of 4 x 4 pixels, one vector each: fragments of blocks in a list, and images by block.
#pragma once

#include "cpu/simd.h"
#include "cpu/threads.h"
#include "ops/arguments.h"

namespace bt {

constexpr int kBlockSide = 4, kBlocksAcross = kTile / kBlockSide, kBlocks = kBlocksAcross * kBlocksAcross;
static_assert(kBlocks == kLanes && kBlocksAcross == 4, "a bit and a lane for each block of a tile");

// Returns a block's first pixel within its tile.
constexpr int block_column(int block) { return block % kBlocksAcross * kBlockSide; }
constexpr int block_row(int block) { return block / kBlocksAcross * kBlockSide; }
// Returns a pixel's position within its block.
constexpr int lane_column(int lane) { return lane % kBlockSide; }
constexpr int lane_row(int lane) { return lane / kBlockSide; }
// Pixel centres of a block, from its corner.
template <class S> struct BlockCentres {
  Lanes<S> x, y;
  BlockCentres() {
    for (int i = 0; i < kLanes; ++i) x.set(i, pixel_centre<S>(lane_column(i))), y.set(i, pixel_centre<S>(lane_row(i)));
  }
};
template <class S> struct BlockOffsets {
  S column[kBlocks] = {}, row[kBlocks] = {};
  constexpr BlockOffsets() {
    for (int p = 0; p < kBlocks; ++p) column[p] = S(block_column(p)), row[p] = S(block_row(p));
  }
};
template <class S> inline constexpr BlockOffsets<S> kBlockOffsets;

// Pixels of a surfel in a block; their fragments are consecutive by lane.
struct BlockPart {
  uint32_t lanes;
  int block;
  int32_t surfel;

  BlockPart(uint32_t lanes, int block, int32_t surfel) : lanes(lanes), block(block), surfel(surfel) {}
  explicit BlockPart(const int32_t* row) : lanes(row[0] & 0xffff), block(row[0] >> 16), surfel(row[1]) {}
  BlockPart(const TileBlocks& of, int64_t k) : BlockPart(of.blocks + 2 * k) {}
  void write(int32_t* row) const { row[0] = int32_t(lanes) | block << 16, row[1] = surfel; }
  int count() const { return __builtin_popcount(lanes); }
};

// Fragments of a surfel in a tile: `begin` to `end` - 1 of the list, in the blocks `first` to `last` - 1.
struct BlockRun {
  int32_t tile, surfel;
  int64_t begin, end, first, last;
};
// Calls fn(k, at, part) for its blocks k; a block's fragments begin at `at`.
template <class F> BT_HD void each_block(const TileBlocks& of, const BlockRun& run, F&& fn) {
  int64_t at = run.begin;
  for (int64_t k = run.first; k < run.last; ++k) {
    const BlockPart part(of, k);
    fn(k, at, part);
    at += part.count();
  }
}
// Calls fn(run) for the surfels of a tile, front to back.
template <class F> BT_HD void each_run(const TileBlocks& of, int64_t tile, F&& fn) {
  const int64_t last = of.block_start[tile + 1];
  BlockRun run = {int32_t(tile), 0, 0, of.start[tile], 0, of.block_start[tile]};
  while (run.last < last) {
    run.begin = run.end, run.first = run.last, run.surfel = BlockPart(of, run.first).surfel;
    do run.end += BlockPart(of, run.last).count();
    while (++run.last < last && BlockPart(of, run.last).surfel == run.surfel);
    fn(run);
  }
}
template <class F> BT_HD void each_run_back(const TileBlocks& of, int64_t tile, F&& fn) {
  const int64_t first = of.block_start[tile];
  BlockRun run = {int32_t(tile), 0, of.start[tile + 1], 0, of.block_start[tile + 1], 0};
  while (run.first > first) {
    run.end = run.begin, run.last = run.first, run.surfel = BlockPart(of, run.last - 1).surfel;
    do run.begin -= BlockPart(of, --run.first).count();
    while (run.first > first && BlockPart(of, run.first - 1).surfel == run.surfel);
    fn(run);
  }
}

// Returns the first pixel of a tile's block in an image; pixels_on: a lane's offset from it.
inline int64_t first_pixel(int64_t tile, int block, int width) {
  const int64_t corner = (tile / tiles_across(width) * width + tile % tiles_across(width)) * kTile;
  return corner + block_row(block) * width + block_column(block);
}
constexpr int pixels_on(int lane, int width) { return lane_row(lane) * width + lane_column(lane); }
// Calls fn(run, i, pixel) for the fragments i of a tile, in the list's order.
template <class F> BT_HD void each_fragment(const TileBlocks& of, int64_t tile, int width, F&& fn) {
  each_run(of, tile, [&](const BlockRun& run) {
    each_block(of, run, [&](int64_t, int64_t at, const BlockPart& part) {
      const int64_t from = first_pixel(tile, part.block, width);
      for (uint32_t lanes = part.lanes; lanes; lanes &= lanes - 1)
        fn(run, at++, from + pixels_on(__builtin_ctz(lanes), width));
    });
  });
}

// Calls fn(pixel, block, lane) for the pixels of a tile inside an image.
template <class F> BT_HD void each_pixel(int64_t tile, int width, int height, F&& fn) {
  const int x0 = int(tile % tiles_across(width)) * kTile, y0 = int(tile / tiles_across(width)) * kTile;
  for (int block = 0; block < kBlocks; ++block)
    for (int lane = 0; lane < kLanes; ++lane) {
      const int x = x0 + block_column(block) + lane_column(lane), y = y0 + block_row(block) + lane_row(lane);
      if (x < width && y < height) fn(int64_t(y) * width + x, block, lane);
    }
}

// An image by tile, block and channel, the 16 pixels of a block contiguous; 0 outside the image.
template <class S, int channels> class BlockPicture {
 public:
  BlockPicture(const S* rows, int width, int height)
      : memory_(allocate(tiles_of(width, height) * kTile * kTile * channels * sizeof(S), true)) {
    parallel_each(tiles_of(width, height), 16, [&](int64_t tile) {
      S* to = numbers(tile, 0);
      std::fill(to, to + kTile * kTile * channels, S(0));
      each_pixel(tile, width, height, [&](int64_t pixel, int block, int lane) {
        for (int c = 0; c < channels; ++c) to[(block * channels + c) * kLanes + lane] = rows[pixel * channels + c];
      });
    });
  }
  const S* numbers(int64_t tile, int block) const { return const_cast<BlockPicture*>(this)->numbers(tile, block); }

 private:
  S* numbers(int64_t tile, int block) {
    return reinterpret_cast<S*>(memory_.get()) + (tile * kBlocks + block) * channels * kLanes;
  }
  Memory memory_;
};

}  // namespace bt
