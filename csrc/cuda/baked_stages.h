// What the stages of the baked renderer share: working memory, a surfel's row, and the tiles it touches.
#pragma once

#include "core/reach.h"
#include "cuda/baked.h"

namespace bt::cuda {

constexpr int kBands = 4, kBandRows = kTile / kBands;
constexpr uint32_t kNeverSeen = 0xffffffffu;  // depth key of a surfel that is not visible

// A surfel's row: the first twelve columns are those of GeomColumn. 24 floats are three sectors of 32 bytes.
enum RowColumn {
  kR2 = kBeta + 1,  // level set u^2 + v^2 <= r2
  kBlur2,           // and d^2 <= blur2; 0: the low pass does not show; -kArea where PixelKernel filters the surfel
  kRed,             // relu(view colour + 0.5), three
  kTexelScale = kRed + 3,  // 1 / (2 extent); 0: no residual; -1: a constant one
  kPage,                   // handle of the texture, 64 bits
  kTileX = kPage + 2,      // centre of the tile's first texel, two; or three: the colour with the constant residual
  kSpanX = kTileX + 2,     // texels of the tile less one, two
  kRow = kSpanX + 2
};
static_assert(kRow == 24 && kR2 == 12);

struct BakedMemory {
  int64_t* total;                                       // [2] pairs of surfel and tile; by how many the lists differ
  float* rows;                                          // [rows, kRow]
  float4* normals;                                      // [rows], null: not wanted
  uint32_t *depth, *depth_sorted;                       // [rows]
  int32_t *unsorted, *order, *counts, *ordered_counts;  // [rows] row numbers, the same by depth; tiles of a row
  int64_t* offsets;                                     // [rows]
  void *keys, *keys_sorted;                             // [capacity] tile of a pair, uint16 or uint32
  int32_t *values, *values_sorted;                      // [capacity] row << 8 | mask
  int32_t* ranges;                                      // [tiles, 2]
  void* scratch;                                        // of the sorts and the sum
  int64_t scratch_bytes;
};

struct BakedFrame {
  int64_t n, rows, capacity;  // surfels; surfels times views; room for pairs
  int width, height, tiles_x, tiles_y;
  int64_t tiles;       // of all views
  int key_bits;        // tile numbers and the key of unused room
  bool wide;           // keys of 32 bits
  bool through_pixel;  // as in BakedScene
  BakedMemory memory;
};

void baked_prepare(const BakedScene& surfels, const BakedViews& views, const BakedFrame& frame, Stream stream);
void baked_bin(const BakedFrame& frame, Stream stream);
void baked_draw(const BakedScene& surfels, const BakedImages& images, const BakedFrame& frame, Stream stream);

// The pixels that a surfel can touch, by tile.
struct Footprint {
  Reach<float> reach;
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
template <class Kernel>
BT_HD Footprint footprint(const float* row, int height) {
  Footprint f;
  if (Kernel::kPixel && row[kBlur2] < 0) {
    float geom[kGeom];
    geom_of(row, geom);
    f.reach = filtered_reach<float>(geom).reach;
  } else {
    f.reach = reach(row, row[kR2], row[kBlur2]);
  }
  f.cx = row[kCx], f.cy = row[kCy];
  f.pad = float(kBoundPad) + 1e-6f * (abs_(f.cx) + abs_(f.cy));
  const Reach<float>& e = f.reach;
  Interval<float> y;
  if (e.ellipse) y.add(e.y0 - f.pad, e.y1 + f.pad);
  if (e.blur > 0) y.add(-e.blur, e.blur);
  const int first = e.whole ? 0 : pixel_from(f.cy + y.x0, height),
            last = e.whole ? height - 1 : pixel_to(f.cy + y.x1, height);
  f.top = first / kTile, f.bottom = last / kTile;
  if (first > last) f.top = 0, f.bottom = -1;
  return f;
}

// A row of tiles: the pixels that can be touched in each of its bands of four rows, and the tiles of these.
struct TileRow {
  int from[kBands], to[kBands];  // pixels, none when from > to
  int left, right;               // tiles, none when left > right
};
BT_HD TileRow tile_row(const Footprint& f, int ty, int width) {
  TileRow r;
  const Reach<float>& e = f.reach;
  int from = width, to = -1;
  Interval<float> upper;  // crossings with the line above a band; below it those of the next
  if (e.ellipse && !e.whole) add_crossings(e, ty * kTile - f.cy, upper);
  for (int band = 0; band < kBands; ++band) {
    const float lo = ty * kTile + band * kBandRows - f.cy, hi = lo + kBandRows;
    Interval<float> x;
    if (e.whole) {
      x.add(-1e30f, 1e30f);
    } else if (e.ellipse) {
      Interval<float> lower;
      add_crossings(e, hi, lower);
      x.add(min_(upper.x0, lower.x0), max_(upper.x1, lower.x1));
      upper = lower;
      add_outermost(e, lo, hi, f.pad + float(kBoundSlack) * (e.y1 - e.y0), x);
      x.x0 -= f.pad, x.x1 += f.pad;
    }
    if (!e.whole) add_low_pass(e, lo, hi, x);
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

// Sums of the values of the threads before mine, of the warp or of a block of kBlock threads.
constexpr int kBlock = 128, kBlockWarps = kBlock / kWarp;
__device__ inline int warp_sum_before(int value, int lane) {
  int sum = value;
  for (int by = 1; by < kWarp; by *= 2) {
    const int left = __shfl_up_sync(kFullMask, sum, by);
    if (lane >= by) sum += left;
  }
  return sum - value;
}
// `sums`: kBlockWarps numbers in shared memory. All threads of the block take part.
__device__ inline int block_sum_before(int value, int* sums, int& total) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  int before = warp_sum_before(value, lane);
  if (lane == kWarp - 1) sums[warp] = before + value;
  __syncthreads();
  total = 0;
  for (int k = 0; k < kBlockWarps; ++k) {
    if (k < warp) before += sums[k];
    total += sums[k];
  }
  __syncthreads();
  return before;
}
// The last of `count` > 0 ascending numbers, of which the first is 0, that is at most i.
BT_HD int last_at_most(const int* numbers, int count, int i) {
  int low = 0;
  for (int high = count; high - low > 1;) {
    const int middle = (low + high) / 2;
    (numbers[middle] <= i ? low : high) = middle;
  }
  return low;
}

// Room for one footprint per thread in shared memory, where nothing may have a constructor.
struct alignas(Footprint) FootprintRoom {
  unsigned char bytes[sizeof(Footprint)];
};
__device__ inline Footprint& footprint_in(FootprintRoom& room) { return *reinterpret_cast<Footprint*>(&room); }

}  // namespace bt::cuda
