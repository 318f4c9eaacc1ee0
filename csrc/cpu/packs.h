// A tile is 16 packs of 4 x 4 pixels, each a vector: the fragments of packs in a list, and pictures by pack.
#pragma once

#include "cpu/memory.h"
#include "cpu/simd.h"
#include "cpu/threads.h"
#include "ops/arguments.h"

namespace bt {

constexpr int kPackSide = 4, kPacksAcross = kTile / kPackSide, kPacks = kPacksAcross * kPacksAcross;
static_assert(kPacks == kLanes && kPacksAcross == 4, "a bit and a lane for each pack of a tile");

// A pack's first pixel in its tile.
constexpr int pack_column(int pack) { return pack % kPacksAcross * kPackSide; }
constexpr int pack_row(int pack) { return pack / kPacksAcross * kPackSide; }
// A pixel's place in its pack.
constexpr int lane_column(int lane) { return lane % kPackSide; }
constexpr int lane_row(int lane) { return lane / kPackSide; }
// The centres of a pack's pixels, from its corner on.
template <class S>
struct PackCentres {
  Pack<S> x, y;
  PackCentres() {
    for (int i = 0; i < kLanes; ++i) x.set(i, pixel_centre<S>(lane_column(i))), y.set(i, pixel_centre<S>(lane_row(i)));
  }
};
// A pack's first pixel as reals, which would else be converted for every pack that is drawn.
template <class S>
struct PackOffsets {
  S column[kPacks] = {}, row[kPacks] = {};
  constexpr PackOffsets() {
    for (int p = 0; p < kPacks; ++p) column[p] = S(pack_column(p)), row[p] = S(pack_row(p));
  }
};
template <class S>
inline constexpr PackOffsets<S> kPackOffsets;

// What a list has of a surfel in a pack: which of its pixels. Their fragments follow each other by lane.
struct PackPart {
  uint32_t lanes;
  int pack;
  int32_t surfel;

  PackPart(uint32_t lanes, int pack, int32_t surfel) : lanes(lanes), pack(pack), surfel(surfel) {}
  explicit PackPart(const int32_t* row) : lanes(row[0] & 0xffff), pack(row[0] >> 16), surfel(row[1]) {}
  PackPart(const TilePacks& of, int64_t k) : PackPart(of.packs + 2 * k) {}
  void write(int32_t* row) const { row[0] = int32_t(lanes) | pack << 16, row[1] = surfel; }
  int count() const { return __builtin_popcount(lanes); }
};

// The fragments of a surfel in a tile: `begin` to `end` - 1 of the list, in the packs `first` to `last` - 1.
struct PackRun {
  int32_t tile, surfel;
  int64_t begin, end, first, last;
};
// fn(k, at, part) for its packs k; a pack's fragments begin at `at`.
template <class F>
BT_HD void each_pack(const TilePacks& of, const PackRun& run, F&& fn) {
  int64_t at = run.begin;
  for (int64_t k = run.first; k < run.last; ++k) {
    const PackPart part(of, k);
    fn(k, at, part);
    at += part.count();
  }
}
// fn(run) for the surfels of a tile, front to back.
template <class F>
BT_HD void each_run(const TilePacks& of, int64_t tile, F&& fn) {
  const int64_t last = of.pack_start[tile + 1];
  PackRun run = {int32_t(tile), 0, 0, of.start[tile], 0, of.pack_start[tile]};
  while (run.last < last) {
    run.begin = run.end, run.first = run.last, run.surfel = PackPart(of, run.first).surfel;
    do run.end += PackPart(of, run.last).count();
    while (++run.last < last && PackPart(of, run.last).surfel == run.surfel);
    fn(run);
  }
}
// The same, back to front.
template <class F>
BT_HD void each_run_back(const TilePacks& of, int64_t tile, F&& fn) {
  const int64_t first = of.pack_start[tile];
  PackRun run = {int32_t(tile), 0, of.start[tile + 1], 0, of.pack_start[tile + 1], 0};
  while (run.first > first) {
    run.end = run.begin, run.last = run.first, run.surfel = PackPart(of, run.last - 1).surfel;
    do run.begin -= PackPart(of, --run.first).count();
    while (run.first > first && PackPart(of, run.first - 1).surfel == run.surfel);
    fn(run);
  }
}

// The first pixel of a tile's pack in an image, and another lane's from it on.
inline int64_t first_pixel(int64_t tile, int pack, int width) {
  const int64_t corner = (tile / tiles_across(width) * width + tile % tiles_across(width)) * kTile;
  return corner + pack_row(pack) * width + pack_column(pack);
}
constexpr int pixels_on(int lane, int width) { return lane_row(lane) * width + lane_column(lane); }
// fn(run, i, pixel) for the fragments i of a tile, in the list's order.
template <class F>
BT_HD void each_fragment(const TilePacks& of, int64_t tile, int width, F&& fn) {
  each_run(of, tile, [&](const PackRun& run) {
    each_pack(of, run, [&](int64_t, int64_t at, const PackPart& part) {
      const int64_t from = first_pixel(tile, part.pack, width);
      for (uint32_t lanes = part.lanes; lanes; lanes &= lanes - 1)
        fn(run, at++, from + pixels_on(__builtin_ctz(lanes), width));
    });
  });
}

// fn(pixel, pack, lane) for the pixels of a tile that lie in an image.
template <class F>
BT_HD void each_pixel(int64_t tile, int width, int height, F&& fn) {
  const int x0 = int(tile % tiles_across(width)) * kTile, y0 = int(tile / tiles_across(width)) * kTile;
  for (int pack = 0; pack < kPacks; ++pack)
    for (int lane = 0; lane < kLanes; ++lane) {
      const int x = x0 + pack_column(pack) + lane_column(lane), y = y0 + pack_row(pack) + lane_row(lane);
      if (x < width && y < height) fn(int64_t(y) * width + x, pack, lane);
    }
}

// The rows of a picture by packs: its channels lie 16 pixels at a time. Outside of it they are 0.
template <class S, int channels>
class PackedPicture {
 public:
  PackedPicture(const S* rows, int width, int height)
      : memory_(allocate(tiles_of(width, height) * kTile * kTile * channels * sizeof(S), true)) {
    parallel_parts(tiles_of(width, height), 16, [&](int, int64_t begin, int64_t end) {
      for (int64_t tile = begin; tile < end; ++tile) {
        S* to = numbers(tile, 0);
        std::fill(to, to + kTile * kTile * channels, S(0));
        each_pixel(tile, width, height, [&](int64_t pixel, int pack, int lane) {
          for (int c = 0; c < channels; ++c) to[(pack * channels + c) * kLanes + lane] = rows[pixel * channels + c];
        });
      }
    });
  }
  const S* numbers(int64_t tile, int pack) const { return const_cast<PackedPicture*>(this)->numbers(tile, pack); }

 private:
  S* numbers(int64_t tile, int pack) {
    return reinterpret_cast<S*>(memory_.get()) + (tile * kPacks + pack) * channels * kLanes;
  }
  Memory memory_;
};

}  // namespace bt
