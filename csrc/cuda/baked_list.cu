// A frame of the baked renderer: working memory, and the first stage, the visible surfels, as rows for drawing, and
// their screen tiles.
//
// One thread per surfel, 44 bytes in and, if visible, 100 out. A block then lists the pairs of its surfels from their
// footprints in shared memory. View colours (196 bytes of parameters per surfel with seven sites, 20 + 24 per term of
// reduced ones) are computed for visible surfels only, by adjacent threads: a block compacts them.
//
// There is no sort over all surfels or pairs, and tiles are found once. A pair takes the next slot of its tile,
// by the tile's counter; when the slots are full, it goes to one list of all tiles. Each tile's list is sorted when the
// tile is drawn (baked_sort.h), so the image does not depend on the order of insertion.
#include <stdexcept>
#include <string>

#include "core/blend.h"
#include "core/view_color.h"
#include "cuda/baked_stages.h"
#include "cuda/sort_scan.h"
#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int64_t kMostBlocks = 1024;  // a block takes fewer surfels while there are at most this many blocks,
constexpr int kLeastOwned = 4;         // but at least this many surfels
constexpr int kLargeParts = 16;        // shares of the tile rows of a surfel with many tiles
constexpr int kLargeBlocks = 528;      // four per multiprocessor of a large GPU
constexpr int kListThreads = 128, kListWarps = kListThreads / kWarp;
constexpr int kLarge = 128;  // tiles from which a surfel is handled by `large_pairs_kernel`

// Exclusive prefix sum over the block's threads, with barriers. `sums`: kListWarps numbers in shared memory.
__device__ int block_sum_before(int value, int* sums, int& total) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  int before = sum_below(value, lane);
  if (lane == kWarp - 1) sums[warp] = before + value;
  __syncthreads();
  total = 0;
  for (int k = 0; k < kListWarps; ++k) {
    if (k < warp) before += sums[k];
    total += sums[k];
  }
  __syncthreads();
  return before;
}
// Returns the index of the last number that is at most i, of `count` > 0 ascending ones from 0 on.
__device__ int last_at_most(const int* numbers, int count, int i) {
  int low = 0;
  for (int high = count; high - low > 1;) {
    const int middle = (low + high) / 2;
    (numbers[middle] <= i ? low : high) = middle;
  }
  return low;
}

// Storage of a footprint in shared memory, where constructors are not allowed.
struct alignas(Footprint<float>) FootprintRoom {
  unsigned char bytes[sizeof(Footprint<float>)];
};
__device__ Footprint<float>& footprint_in(FootprintRoom& room) { return *reinterpret_cast<Footprint<float>*>(&room); }

// Bounds the number of tiles listed for a surfel with a box.
__device__ int most_tiles(const Footprint<float>& of, const BakedFrame& f) {
  const Interval<float> x = columns_of(of);
  const int left = pixel_from(x.x0, f.width) / kTile, right = pixel_to(x.x1, f.width) / kTile;
  return (of.bottom - of.top + 1) * max_(right - left + 1, 1);
}

// Returns the first tile of the row of tiles `ty`, in the view of the surfel with row `r`.
__device__ uint32_t first_tile(const BakedFrame& f, uint32_t r, int ty) {
  return r / uint32_t(f.n) * uint32_t(f.tiles_x * f.tiles_y) + uint32_t(ty * f.tiles_x);
}

__device__ void list_pair(const BakedFrame& f, uint32_t r, uint32_t tile, uint32_t parts) {
  const BakedMemory& m = f.memory;
  TileList& list = m.lists[tile];
  const uint32_t pair = r << 8 | parts;
  const int number = atomicAdd(&list.count, 1);
  if (number == f.long_from) {
    const int32_t at = atomicAdd(m.long_count, 1);
    m.long_tiles[at] = tile, list.long_index = uint32_t(at + 1);
  }
  if (number < f.slots) {
    m.pairs[int64_t(tile) * f.slots + number] = pair;
    return;
  }
  const int64_t at = add_to(m.spilled_count, 1);
  if (at < f.capacity) m.spilled[at] = {pair, atomicExch(&list.chains[number % kChains], uint32_t(at + 1))};
}

// Lists the pairs of the block's surfels: `area` has the footprints of `owned` of them, starting at row `first`; `mine`
// is the number of tile rows of the thread's surfel. Threads first take a row of tiles each, then a pair each, so that
// the load is balanced for surfels of any height and width.
__device__ void list_pairs(const BakedFrame& f, FootprintRoom* area, int owned, int64_t first, int mine) {
  __shared__ int first_row[kListThreads];  // rows of tiles before a surfel's
  __shared__ TileRow row[kListThreads];
  __shared__ uint32_t row_id[kListThreads], row_tile[kListThreads];  // a row's surfel and its leftmost tile
  __shared__ int first_pair[kListThreads];                           // pairs before a row's
  __shared__ int sums[kListWarps];
  const int me = threadIdx.x;
  int rows = 0;
  first_row[me] = block_sum_before(mine, sums, rows);
  __syncthreads();
  for (int next = 0; next < rows; next += kListThreads) {
    const int taken = min_(rows - next, kListThreads);
    int pairs = 0, width = 0;
    if (me < taken) {
      const int surfel = last_at_most(first_row, owned, next + me);
      const Footprint<float>& of = footprint_in(area[surfel]);
      const int ty = of.top + (next + me - first_row[surfel]);
      const TileRow mine = tile_row(of, ty, f.width);
      width = mine.right - mine.left + 1;
      row[me] = mine;
      row_id[me] = uint32_t(first + surfel);
      row_tile[me] = first_tile(f, row_id[me], ty) + uint32_t(mine.left);
    }
    first_pair[me] = block_sum_before(width, sums, pairs);
    if (me == 0 && pairs > 0) add_to(f.memory.total, pairs);
    __syncthreads();
    for (int k = me; k < pairs; k += kListThreads) {
      const int of = last_at_most(first_pair, taken, k), right = k - first_pair[of];
      list_pair(f, row_id[of], row_tile[of] + uint32_t(right), part_mask(row[of], row[of].left + right));
    }
    __syncthreads();
  }
}

// The presets' numbers of terms are constants, so that loops unroll and local memory is not used.
__device__ Vec3<float> view_color_of(const BakedScene& s, int64_t i, Vec3<float> d) {
  if (s.colors.reduced.base) return view_color(s.colors.reduced, i, d);
  const ViewColorArrays<const float>& p = s.colors.whole;
  return for_view_color(p.kind, [&](auto kind) {
    using Kind = decltype(kind);
    constexpr int kPreset = Kind::kPresetTerms;
    return p.terms == kPreset ? view_color<Kind>(kPreset, p, i, d) : view_color<Kind>(p.terms, p, i, d);
  });
}

__device__ void write_texture(const BakedScene& s, int64_t i, Vec3<float> color, float photo_pixel, float* row) {
  const int32_t* tile = s.tiles + 5 * i;
  int level = 0;
  if (s.levels[0] && tile[3] != 0 && photo_pixel < 1) {
    level = tile_level(row, tile[3], tile[4], s.extent ? s.extent[i] : float(kSupport), photo_pixel);
    if (level == kTileLevels && !s.mean_residual) level = 0;
    while (level && level < kTileLevels && !(s.levels[level] && has_level(tile, level))) --level;
  }
  float scale = 0, texture[4] = {0, 0, 0, 0};
  if (s.levels[0] && tile[3] != 0 && level < kTileLevels) {
    scale = 0.5f / (s.extent ? s.extent[i] : float(kSupport));
    const int x = tile[0] + tile[2] / s.pages_down * s.page_width, y = tile[1] + tile[2] % s.pages_down * s.page_height;
    texture[0] = float(x >> level) + 0.5f, texture[1] = float(y >> level) + 0.5f;
    texture[2] = float((tile[3] >> level) - 1), texture[3] = float((tile[4] >> level) - 1);
  } else if (s.mean_residual || s.mean_alpha) {
    const Vec3<float> flat = s.mean_residual ? load3(s.mean_residual + 3 * i) : Vec3<float>{0, 0, 0};
    const float alpha = s.mean_alpha ? s.mean_alpha[i] : 1.0f;
    if (flat.x != 0 || flat.y != 0 || flat.z != 0 || alpha != 1) {
      scale = -1;
      store3(texture, shaded(color, flat));
      texture[3] = alpha;
    }
  }
  row[kTexelScale] = scale;
  row[kLevel] = float(level), row[kLevel + 1] = 0;
  for (int k = 0; k < 4; ++k) row[kTileX + k] = texture[k];
}

// A block takes `owned` surfels. Those with many tiles or without a box are deferred, as the block with most of them
// would dominate frame time.
template <class Kernel>
__global__ void __launch_bounds__(kListThreads, bounded_blocks(9, kListThreads))
    list_kernel(BakedScene s, BakedViews v, BakedFrame f, int owned) {
  __shared__ int seen_count;
  __shared__ int seen_list[kListThreads];
  __shared__ FootprintRoom area[kListThreads];
  const int64_t block = int64_t(blockIdx.x) * owned, i = block + threadIdx.x;
  const int view = blockIdx.y;
  const bool owns = int(threadIdx.x) < owned && i < f.n;
  const int64_t first = f.n * view, at = first + i;  // row of the view's first surfel; of this one
  if (threadIdx.x == 0) seen_count = 0;
  __syncthreads();

  float row[kGeom];
  bool seen = false;
  int rows = 0;  // rows of tiles
  float z = 0;
  if (owns) {
    const Surfels<float>& in = s.geometry;
    float geom[kGeom], frame[kFrame];
    const Pinhole<float> camera = pinhole(v.viewmats + 16 * view, v.Ks + 9 * view);
    seen = project(camera, surfel_row(in, i), s.near, geom, frame);
    const Resize<float> to(f.photo_pixel);
    if constexpr (Kernel::kResized) seen = seen && resize(to, geom);
    if (seen) {
      seen = level_row<Kernel>(geom, s.near, to.sharp, row);
      const Footprint<float> of = footprint(row, v.width, v.height);
      const Interval<float> x = columns_of(of);
      seen = seen && of.top <= of.bottom && (of.bounds.whole || (x.x1 >= 0 && x.x0 <= v.width));
      z = geom[kZ];
      if (seen && (of.bounds.whole || most_tiles(of, f) >= kLarge))
        f.memory.large[atomicAdd(f.memory.large_count, 1)] = uint32_t(at);
      else if (seen)
        footprint_in(area[threadIdx.x]) = of, rows = of.bottom - of.top + 1;
      // if the nearest point of the disc lies beyond `near`, all of it does
      const PlaneBounds<float>& disc = of.bounds;
      const float nearest = z * (1 - sqrt_(disc.cu * disc.cu + disc.cv * disc.cv));
      if (row[kBlur2] == 0 && (disc.whole || !(nearest > s.near * 1.0001f))) row[kBlur2] = kNearCuts;
    }
    if (seen) {
      float4* to = reinterpret_cast<float4*>(f.memory.rows + at * kRow);
      for (int k = 0; k < 3; ++k) to[k] = make_float4(row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]);
      f.memory.rows[at * kRow + kR2] = row[kR2], f.memory.rows[at * kRow + kBlur2] = row[kBlur2];
      if (f.memory.normals) f.memory.normals[at] = make_float4(geom[kNx], geom[kNy], geom[kNz], 0);
    }
  }
  if (owns) f.memory.depth[at] = seen ? sort_key(z) : kNeverSeen;

  if (seen) seen_list[atomicAdd(&seen_count, 1)] = threadIdx.x;
  __syncthreads();
  if (int(threadIdx.x) < seen_count) {
    const int64_t j = block + seen_list[threadIdx.x];
    double center[3];
    camera_center(v.viewmats + 16 * view, center);
    const Vec3<float> d = view_direction(s.geometry.means + 3 * j, center).n;
    const Vec3<float> color = view_base(view_color_of(s, j, d));
    float* to = f.memory.rows + (first + j) * kRow;
    store3(to + kRed, color);
    write_texture(s, j, color, f.photo_pixel, to);
  }
  list_pairs(f, area, owned, first + block, rows);
}

// Lists a row of tiles of a surfel without a box, one tile per lane. Returns their number.
__device__ int list_reached(const BakedFrame& f, uint32_t r, int ty, int lane) {
  const float* row = f.memory.rows + int64_t(r) * kRow;
  const uint32_t tile = first_tile(f, r, ty);
  int listed = 0;
  for (int first = 0; first < f.tiles_x; first += kWarp) {
    const int tx = first + lane;
    const uint32_t parts = tx < f.tiles_x ? reached_parts(row, tx, ty) : 0;
    listed += __popc(__ballot_sync(kFullMask, parts != 0));
    if (parts) list_pair(f, r, tile + uint32_t(tx), parts);
  }
  return listed;
}

// Lists the deferred surfels, a warp per share of the tile rows of one.
__global__ void __launch_bounds__(kListThreads, 4) large_pairs_kernel(BakedFrame f) {
  const BakedMemory& m = f.memory;
  const int lane = threadIdx.x % kWarp, warps = int(gridDim.x) * kListWarps;
  const int64_t shares = int64_t(*m.large_count) * kLargeParts;
  int64_t listed = 0;
  for (int64_t i = int64_t(blockIdx.x) * kListWarps + threadIdx.x / kWarp; i < shares; i += warps) {
    const uint32_t r = m.large[i / kLargeParts];
    const Footprint<float> of = footprint(m.rows + int64_t(r) * kRow, f.width, f.height);
    for (int ty = of.top + int(i % kLargeParts); ty <= of.bottom; ty += kLargeParts) {
      if (of.bounds.whole) {
        listed += list_reached(f, r, ty, lane);
        continue;
      }
      const TileRow row = tile_row(of, ty, f.width);
      const int width = row.right - row.left + 1;
      const uint32_t tile = first_tile(f, r, ty);
      for (int k = lane; k < width; k += kWarp)
        list_pair(f, r, tile + uint32_t(row.left + k), part_mask(row, row.left + k));
      listed += max_(width, 0);
    }
  }
  if (lane == 0 && listed) add_to(m.total, listed);
}

// The host side of a frame.
constexpr int kLong = 2;         // a long list has more than this times the mean capacity,
constexpr int kLeastLong = 128;  // and at least this many pairs

// Divides the working memory into arrays; returns the bytes needed. With a null base it only counts.
int64_t lay_out(BakedFrame& f, void* base, bool normals) {
  Arena arena(base);
  BakedMemory& m = f.memory;
  m.total = arena.take<int64_t>(4), m.spilled_count = m.total + 1, m.rest_count = m.total + 2;
  m.large_count = reinterpret_cast<int32_t*>(m.total + 3), m.long_count = m.large_count + 1;
  m.lists = arena.take<TileList>(f.tiles);
  m.cleared = arena.used();
  m.rows = arena.take<float>(f.rows * kRow);
  m.normals = normals ? arena.take<float4>(f.rows) : nullptr;
  m.depth = arena.take<uint32_t>(f.rows);
  m.pairs = arena.take<uint32_t>(f.tiles * f.slots + f.capacity);
  m.spilled = arena.take<SpilledPair>(f.capacity);
  m.large = arena.take<uint32_t>(f.rows), m.long_tiles = arena.take<uint32_t>(f.tiles);
  return arena.used();
}

BakedFrame frame_of(int64_t surfels, const BakedViews& v, int slots, int64_t capacity) {
  BakedFrame f = {};
  f.n = surfels, f.rows = surfels * v.count;
  f.width = v.width, f.height = v.height;
  f.tiles_x = tiles_across(v.width), f.tiles_y = tiles_across(v.height);
  f.tiles = int64_t(f.tiles_x) * f.tiles_y * v.count;
  f.slots = slots, f.capacity = max_<int64_t>(capacity, 1);
  if (slots < kWarp || slots % kWarp)
    throw std::invalid_argument("a tile has " + std::to_string(slots) + " slots, it needs a multiple of " +
                                std::to_string(kWarp));
  f.long_from = int(max_<int64_t>(kLong * f.capacity / max_<int64_t>(f.tiles, 1), kLeastLong));
  if (f.rows > kMostRows)
    throw std::invalid_argument("surfels times views is " + std::to_string(f.rows) + ", at most " +
                                std::to_string(kMostRows) + " are drawn in one call: draw fewer views at once");
  // pair indices have 32 bits
  if (f.capacity > kMostPairs || f.tiles > kMostPairs / slots || v.count > 65535)
    throw std::invalid_argument(
        "too many views, pixels or pairs of surfel and tile for one call: draw fewer views at "
        "once, or smaller ones");
  return f;
}
}  // namespace

void baked_list(const BakedScene& s, const BakedViews& v, const BakedFrame& f, Stream stream) {
  fill_zero(reinterpret_cast<char*>(f.memory.total), f.memory.cleared, stream);
  int owned = kListThreads;
  while (owned > kLeastOwned && ceil_div(f.rows, owned / 2) <= kMostBlocks) owned /= 2;
  const dim3 blocks(unsigned(ceil_div(f.n, owned)), unsigned(v.count));
  with_kernel(f.photo_pixel, [&](auto kernel) {
    BT_LAUNCH(list_kernel<decltype(kernel)>, blocks, dim3(kListThreads), 0, stream, s, v, f, owned);
  });
  const dim3 large(unsigned(min_<int64_t>(kLargeBlocks, ceil_div(f.rows * kLargeParts, kListWarps))));
  BT_LAUNCH(large_pairs_kernel, large, dim3(kListThreads), 0, stream, f);
}

size_t baked_memory(int64_t surfels, const BakedViews& views, int slots, int64_t capacity, bool normals) {
  BakedFrame f = frame_of(surfels, views, slots, capacity);
  return lay_out(f, nullptr, normals);
}

void baked_frame(const BakedDraw& a, Stream stream) {
  BakedFrame f = frame_of(a.scene->geometry.n, a.views, a.slots, a.capacity);
  f.photo_pixel = a.photo_pixel;
  const int64_t needed = lay_out(f, a.memory.at, a.images.normal != nullptr);
  if (a.memory.bytes < needed)
    throw std::invalid_argument("the working memory has " + std::to_string(a.memory.bytes) +
                                " bytes, the frame needs " + std::to_string(needed));
  if (f.rows && a.stages & kList) baked_list(*a.scene, a.views, f, stream);
  if (a.stages & kDraw) baked_draw(*a.scene, a.images, f, stream);
}

}  // namespace bt::cuda
