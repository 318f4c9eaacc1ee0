// Shared by the stages of the baked renderer: working memory, a surfel's row, and the tiles it touches.
#pragma once

#include "core/kernel.h"
#include "core/plane_bounds.h"
#include "core/resize.h"
#include "cuda/baked.h"

namespace bt::cuda {

constexpr int kBands = 4, kBandRows = kTile / kBands;
constexpr uint32_t kNeverSeen = 0xffffffffu;  // depth key of a surfel that is not visible

// A surfel's row: the first twelve columns are those of GeomColumn. 24 floats are three sectors of 32 bytes.
enum RowColumn {
  kR2 = kBeta + 1,  // level set u^2 + v^2 <= r2
  kBlur2,           // and d^2 <= blur2; 0: the low pass does not show; -kArea where PixelKernel filters the surfel;
                    // kNearCuts: no low pass, but pixels have to be compared with the near plane. With ResizedKernel it
                    // also says how high the low pass is: 1/255 is left of it there
  kRed,             // relu(view colour + 0.5), three
  kTexelScale = kRed + 3,  // 1 / (2 extent); 0: neither residual nor alpha; -1: constant ones
  kLevel,                  // of the tile; the column after it is free
  kTileX = kLevel + 2,  // centre of the tile's first texel, two; or four: the colour with the constant residual, alpha
  kSpanX = kTileX + 2,  // texels of the tile less one, two
  kRow = kSpanX + 2
};
static_assert(kRow == 24 && kR2 == 12);
constexpr float kNearCuts = -1;  // without PixelKernel, which compares all rows that it does not filter

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

// The pixels that a surfel can touch, by tile.
struct Footprint {
  PlaneBounds<float> bounds;
  float cx, cy, pad;
  int top, bottom;  // rows of tiles, none when top > bottom
};
BT_HD int pixel_from(float x, int most) {  // first pixel centre right of x, 0 to most
  const float i = ceilf(x - 0.5f);
  return i > 0 ? (i < most ? int(i) : most) : 0;
}
BT_HD int pixel_to(float x, int most) {  // last pixel centre left of x, -1 to most - 1
  const float i = floorf(x - 0.5f);
  return i < most - 1 ? (i >= 0 ? int(i) : -1) : most - 1;
}
// A row's columns of geom; those that a row lacks are 0.
BT_HD void geom_of(const float* row, float* geom) {
  for (int k = 0; k < kGeom; ++k) geom[k] = k <= kBeta ? row[k] : 0.0f;
  geom[kArea] = row[kBlur2] < 0 ? -row[kBlur2] : 0.0f;
}
template <class Kernel> BT_HD Footprint footprint(const float* row, int width, int height) {
  Footprint f;
  if (Kernel::kPixel && row[kBlur2] < 0) {
    float geom[kGeom];
    geom_of(row, geom);
    f.bounds = filtered_bounds<float>(geom).bounds;
  } else {
    f.bounds = plane_bounds(row, row[kR2], row[kBlur2], width, height);
  }
  f.cx = row[kCx], f.cy = row[kCy];
  f.pad = float(kBoundPad) + 1e-6f * (abs_(f.cx) + abs_(f.cy));
  const PlaneBounds<float>& e = f.bounds;
  Interval<float> y;
  if (e.ellipse) y.add(e.y0 - f.pad, e.y1 + f.pad);
  if (e.blur > 0) y.add(-e.blur, e.blur);
  const int first = e.whole ? 0 : pixel_from(f.cy + y.x0, height),
            last = e.whole ? height - 1 : pixel_to(f.cy + y.x1, height);
  f.top = first / kTile, f.bottom = last / kTile;
  if (first > last) f.top = 0, f.bottom = -1;
  return f;
}

// Interval of the pixels that it can touch; of a footprint that is not everywhere.
BT_HD Interval<float> columns_of(const Footprint& f) {
  const Interval<float> x = columns_of(f.bounds);
  const float pad = f.bounds.ellipse ? f.pad : 0;
  return {f.cx + x.x0 - pad, f.cx + x.x1 + pad};
}

// A row of tiles: the pixels that can be touched in each of its bands of four rows, and the tiles of these; of a
// footprint with a box.
struct TileRow {
  int from[kBands], to[kBands];  // pixels, none when from > to
  int left, right;               // tiles, none when left > right
};
BT_HD TileRow tile_row(const Footprint& f, int ty, int width) {
  TileRow r;
  const PlaneBounds<float>& e = f.bounds;
  int from = width, to = -1;
  Interval<float> upper;  // crossings with the line above a band; below it those of the next
  if (e.ellipse) add_crossings(e, ty * kTile - f.cy, upper);
  for (int band = 0; band < kBands; ++band) {
    const float lo = ty * kTile + band * kBandRows - f.cy, hi = lo + kBandRows;
    Interval<float> x;
    if (e.ellipse) {
      Interval<float> lower;
      add_crossings(e, hi, lower);
      x.add(min_(upper.x0, lower.x0), max_(upper.x1, lower.x1));
      upper = lower;
      add_outermost(true, e, lo, hi, f.pad + float(kBoundSlack) * (e.y1 - e.y0), x);
      x.x0 -= f.pad, x.x1 += f.pad;
    }
    add_low_pass(true, e, lo, hi, x);
    r.from[band] = x.empty() ? width : pixel_from(f.cx + x.x0, width);
    r.to[band] = x.empty() ? -1 : pixel_to(f.cx + x.x1, width);
    if (r.from[band] <= r.to[band]) from = min_(from, r.from[band]), to = max_(to, r.to[band]);
  }
  r.left = from / kTile, r.right = to / kTile;
  if (from > to) r.left = 0, r.right = -1;
  return r;
}
// Bit 2 band + half is set when the surfel reaches these 8 x 4 pixels of tile tx.
BT_HD uint32_t part_mask(const TileRow& r, int tx) {
  uint32_t mask = 0;
  const int x = tx * kTile, half = kTile / 2;
  for (int band = 0; band < kBands; ++band) {
    mask |= uint32_t(r.from[band] < x + half && r.to[band] >= x) << (2 * band);
    mask |= uint32_t(r.from[band] < x + 2 * half && r.to[band] >= x + half) << (2 * band + 1);
  }
  return mask;
}
// The same for a disc without a box that crosses the camera's plane: the parts that its level set or its low pass
// reaches. All of those of a disc seen through a pixel.
template <class Kernel> BT_HD uint32_t reached_parts(const float* row, int tx, int ty) {
  if (Kernel::kPixel && row[kBlur2] < 0) return (1u << 2 * kBands) - 1;
  constexpr float kPartWidth = kTile / 2;
  const float x = tx * kTile - row[kCx], y = ty * kTile - row[kCy];
  const float half_x = cell_half(0.5f * (kPartWidth - 1), row[kCx], abs_(x) + kTile),
              half_y = cell_half(0.5f * (kBandRows - 1), row[kCy], abs_(y) + kTile);
  uint32_t mask = 0;
  for (int part = 0; part < 2 * kBands; ++part) {
    const Reached<float> r = reached(row, x + (float(part % 2) + 0.5f) * kPartWidth,
                                     y + (float(part / 2) + 0.5f) * kBandRows, half_x, half_y, row[kR2], row[kBlur2]);
    mask |= uint32_t(r.support || r.centre) << part;
  }
  return mask;
}

}  // namespace bt::cuda
