// Second stage of the baked renderer: every tile's surfels front to back, and the host's side of a frame.
//
// No sort runs over all surfels or all pairs, and tiles are found once. A block lists the pairs of its surfels, at a
// place in the list that it draws from one counter; each pair draws its number within its tile from the tile's counter.
// Every tile then takes its range of the lists, the pairs move there, and each tile's list is sorted for itself
// (baked_sort.cu). Where ranges lie and in which order pairs came has no influence on the image.
#include <stdexcept>
#include <string>

#include "cuda/baked_stages.h"
#include "cuda/warp.h"
#include "cuda/workspace.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128, kWarps = kThreads / kWarp;
constexpr int64_t kLeastBlocks = 1024;  // where there are fewer a block takes fewer surfels,
constexpr int kLeastOwned = 4;          // but as many as this
constexpr int kMoved = 4;               // pairs that a thread moves
constexpr int kLarge = 128;             // tiles from which on a surfel is left to `large_pairs_kernel`
constexpr int kLargeParts = 16;         // in which such a surfel's rows of tiles are shared out
constexpr int kLong = 2;                // times the mean of all tiles: a list that is long
constexpr int kLargeBlocks = 528;       // four for each multiprocessor of a large card

// Sums of the values of the threads before mine.
__device__ int warp_sum_before(int value, int lane) {
  int sum = value;
  for (int by = 1; by < kWarp; by *= 2) {
    const int left = __shfl_up_sync(kFullMask, sum, by);
    if (lane >= by) sum += left;
  }
  return sum - value;
}
// `sums`: kWarps numbers in shared memory. All threads of the block take part; it ends with a barrier.
__device__ int block_sum_before(int value, int* sums, int& total) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  int before = warp_sum_before(value, lane);
  if (lane == kWarp - 1) sums[warp] = before + value;
  __syncthreads();
  total = 0;
  for (int k = 0; k < kWarps; ++k) {
    if (k < warp) before += sums[k];
    total += sums[k];
  }
  __syncthreads();
  return before;
}
// The last of `count` > 0 ascending numbers, of which the first is 0, that is at most i.
__device__ int last_at_most(const int* numbers, int count, int i) {
  int low = 0;
  for (int high = count; high - low > 1;) {
    const int middle = (low + high) / 2;
    (numbers[middle] <= i ? low : high) = middle;
  }
  return low;
}

// Room for a footprint in shared memory, where nothing may have a constructor.
struct alignas(Footprint) FootprintRoom {
  unsigned char bytes[sizeof(Footprint)];
};
__device__ Footprint& footprint_in(FootprintRoom& room) { return *reinterpret_cast<Footprint*>(&room); }

// At most so many tiles are listed for a surfel that has a box.
__device__ int most_tiles(const Footprint& of, const BakedFrame& f) {
  const Interval<float> x = columns_of(of);
  const int left = pixel_from(x.x0, f.width) / kTile, right = pixel_to(x.x1, f.width) / kTile;
  return (of.bottom - of.top + 1) * max_(right - left + 1, 1);
}

// The first tile of row `ty` of the view that row `r` of the surfels belongs to.
__device__ uint32_t first_tile(const BakedFrame& f, uint32_t r, int ty) {
  return r / uint32_t(f.n) * uint32_t(f.tiles_x * f.tiles_y) + uint32_t(ty * f.tiles_x);
}

__device__ void list_pair(const BakedFrame& f, int64_t at, uint32_t r, uint32_t tile, uint32_t parts) {
  const BakedMemory& m = f.memory;
  if (at >= f.capacity) return;
  const int32_t number = atomicAdd(m.ranges + 2 * int64_t(tile) + 1, 1);
  m.listed_tile[at] = tile;
  m.listed_pair[at] = r << 8 | parts;
  m.listed_number[at] = number;
}

__device__ int64_t take_places(const BakedFrame& f, int pairs) {
  return int64_t(
      atomicAdd(reinterpret_cast<unsigned long long*>(f.memory.total), static_cast<unsigned long long>(pairs)));
}

// Threads take a surfel each, then a row of tiles each, then a pair each, so that all are busy and neighbours write to
// neighbouring places however many rows a surfel has and however wide they are. A block takes `owned` surfels. Those
// of many tiles, or without a box, are only noted: the block with most of them would be what a frame waits for.
template <class Kernel>
__global__ void __launch_bounds__(kThreads, 8) pairs_kernel(BakedFrame f, int owned) {
  __shared__ FootprintRoom area[kThreads];
  __shared__ int first_row[kThreads];  // rows of tiles before a surfel's
  __shared__ TileRow row[kThreads];
  __shared__ uint32_t row_id[kThreads], row_tile[kThreads];  // a row's surfel and the tile at its left end
  __shared__ int first_pair[kThreads];                       // pairs before a row's
  __shared__ int sums[kWarps];
  __shared__ int64_t place;
  const BakedMemory& m = f.memory;
  const int me = threadIdx.x;
  const int64_t first = int64_t(blockIdx.x) * owned, r = first + me;
  int mine = 0, rows = 0;
  if (me < owned && r < f.rows && m.depth[r] != kNeverSeen) {
    const Footprint of = footprint<Kernel>(m.rows + r * kRow, f.width, f.height);
    footprint_in(area[me]) = of;
    mine = of.bottom - of.top + 1;
    if (of.bounds.whole || most_tiles(of, f) >= kLarge) m.large[atomicAdd(m.large_count, 1)] = uint32_t(r), mine = 0;
  }
  first_row[me] = block_sum_before(mine, sums, rows);
  __syncthreads();
  for (int next = 0; next < rows; next += kThreads) {
    const int taken = min_(rows - next, kThreads);
    int pairs = 0, width = 0;
    if (me < taken) {
      const int surfel = last_at_most(first_row, owned, next + me);
      const Footprint& of = footprint_in(area[surfel]);
      const int ty = of.top + (next + me - first_row[surfel]);
      const TileRow mine = tile_row(of, ty, f.width);
      width = mine.right - mine.left + 1;
      row[me] = mine;
      row_id[me] = uint32_t(first + surfel);
      row_tile[me] = first_tile(f, row_id[me], ty) + uint32_t(mine.left);
    }
    first_pair[me] = block_sum_before(width, sums, pairs);
    if (me == 0 && pairs > 0) place = take_places(f, pairs);
    __syncthreads();
    for (int k = me; k < pairs; k += kThreads) {
      const int of = last_at_most(first_pair, taken, k), right = k - first_pair[of];
      list_pair(f, place + k, row_id[of], row_tile[of] + uint32_t(right), part_mask(row[of], row[of].left + right));
    }
    __syncthreads();
  }
}

// Lists a row of tiles of a surfel without a box, of which lanes take a tile each.
template <class Kernel>
__device__ void list_reached(const BakedFrame& f, uint32_t r, int ty, int lane) {
  const float* row = f.memory.rows + int64_t(r) * kRow;
  const uint32_t tile = first_tile(f, r, ty);
  for (int first = 0; first < f.tiles_x; first += kWarp) {
    const int tx = first + lane;
    const uint32_t parts = tx < f.tiles_x ? reached_parts<Kernel>(row, tx, ty) : 0;
    const unsigned votes = __ballot_sync(kFullMask, parts != 0);
    int64_t place = 0;
    if (lane == 0 && votes) place = take_places(f, __popc(votes));
    place = __shfl_sync(kFullMask, place, 0);
    if (parts) list_pair(f, place + count_below(votes, lane), r, tile + uint32_t(tx), parts);
  }
}

// The surfels of many tiles and those without a box, a warp to a share of the rows of tiles of one.
template <class Kernel>
__global__ void __launch_bounds__(kThreads) large_pairs_kernel(BakedFrame f) {
  const BakedMemory& m = f.memory;
  const int lane = threadIdx.x % kWarp, warps = int(gridDim.x) * kWarps;
  const int64_t shares = int64_t(*m.large_count) * kLargeParts;
  for (int64_t i = int64_t(blockIdx.x) * kWarps + threadIdx.x / kWarp; i < shares; i += warps) {
    const uint32_t r = m.large[i / kLargeParts];
    const Footprint of = footprint<Kernel>(m.rows + int64_t(r) * kRow, f.width, f.height);
    for (int ty = of.top + int(i % kLargeParts); ty <= of.bottom; ty += kLargeParts) {
      if (of.bounds.whole) {
        list_reached<Kernel>(f, r, ty, lane);
        continue;
      }
      const TileRow row = tile_row(of, ty, f.width);
      const int width = row.right - row.left + 1;
      if (width <= 0) continue;
      int64_t place = 0;
      if (lane == 0) place = take_places(f, width);
      place = __shfl_sync(kFullMask, place, 0);
      const uint32_t tile = first_tile(f, r, ty);
      for (int k = lane; k < width; k += kWarp)
        list_pair(f, place + k, r, tile + uint32_t(row.left + k), part_mask(row, row.left + k));
      __syncwarp();
    }
  }
}

// From the number of a tile's pairs to where they begin and end. Tiles of long lists are drawn first, so that none of
// them is left when all others are done.
__global__ void __launch_bounds__(kThreads) ranges_kernel(BakedFrame f) {
  const BakedMemory& m = f.memory;
  const int64_t tile = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = threadIdx.x % kWarp;
  const bool in = tile < f.tiles;
  const int count = in ? m.ranges[2 * tile + 1] : 0;
  const int before = warp_sum_before(count, lane);
  const bool is_long = in && int64_t(count) * f.tiles > kLong * *m.total;
  const unsigned longs = __ballot_sync(kFullMask, is_long), others = __ballot_sync(kFullMask, in && !is_long);
  int32_t begin = 0, first = 0, last = 0;
  if (lane == kWarp - 1) {
    begin = atomicAdd(m.given, before + count);
    if (longs) first = atomicAdd(m.long_tiles, __popc(longs));
    if (others) last = atomicAdd(m.other_tiles, __popc(others));
  }
  begin = __shfl_sync(kFullMask, begin, kWarp - 1) + before;
  first = __shfl_sync(kFullMask, first, kWarp - 1) + count_below(longs, lane);
  last = __shfl_sync(kFullMask, last, kWarp - 1) + count_below(others, lane);
  if (!in) return;
  m.ranges[2 * tile] = begin, m.ranges[2 * tile + 1] = begin + count;
  m.order[is_long ? first : f.tiles - 1 - last] = uint32_t(tile);
}

__global__ void __launch_bounds__(kThreads) places_kernel(BakedFrame f) {
  const BakedMemory& m = f.memory;
  const int64_t listed = min_(*m.total, f.capacity);
  const int64_t from = int64_t(blockIdx.x) * (kThreads * kMoved) + threadIdx.x;
  uint32_t pair[kMoved];
  int64_t to[kMoved];
  BT_UNROLL
  for (int k = 0; k < kMoved; ++k) {
    const int64_t at = from + k * kThreads;
    if (at >= listed) continue;
    pair[k] = m.listed_pair[at];
    to[k] = int64_t(m.ranges[2 * int64_t(m.listed_tile[at])]) + m.listed_number[at];
  }
  BT_UNROLL
  for (int k = 0; k < kMoved; ++k)
    if (from + k * kThreads < listed) m.pairs[to[k]] = pair[k];
}

// Cuts the working memory into its arrays; the bytes needed. With a null base only the bytes count.
int64_t lay_out(BakedFrame& f, void* base, bool normals) {
  Arena arena(base);
  BakedMemory& m = f.memory;
  m.total = arena.take<int64_t>(3), m.given = reinterpret_cast<int32_t*>(m.total + 1);
  m.large_count = m.given + 1, m.long_tiles = m.given + 2, m.other_tiles = m.given + 3;
  m.ranges = arena.take<int32_t>(2 * f.tiles);
  m.cleared = arena.used();
  m.rows = arena.take<float>(f.rows * kRow);
  m.normals = normals ? arena.take<float4>(f.rows) : nullptr;
  m.depth = arena.take<uint32_t>(f.rows);
  m.pairs = arena.take<uint32_t>(f.capacity);
  m.keys = arena.take<uint64_t>(f.capacity), m.merged = arena.take<uint64_t>(f.capacity);
  m.large = arena.take<uint32_t>(f.rows), m.order = arena.take<uint32_t>(f.tiles);
  m.listed_tile = reinterpret_cast<uint32_t*>(m.keys), m.listed_pair = reinterpret_cast<uint32_t*>(m.merged);
  m.listed_number = reinterpret_cast<int32_t*>(m.listed_tile + f.capacity);
  return arena.used();
}

BakedFrame frame_of(int64_t surfels, const BakedViews& v, int64_t capacity) {
  BakedFrame f = {};
  f.n = surfels, f.rows = surfels * v.count;
  f.width = v.width, f.height = v.height;
  f.tiles_x = tiles_across(v.width), f.tiles_y = tiles_across(v.height);
  f.tiles = int64_t(f.tiles_x) * f.tiles_y * v.count;
  f.capacity = ceil_div(max_<int64_t>(capacity, 1), 8) * 8;
  if (f.rows > kMostRows)
    throw std::invalid_argument("surfels times views is " + std::to_string(f.rows) + ", at most " +
                                std::to_string(kMostRows) + " are drawn in one call: draw fewer views at once");
  if (f.capacity > kMostPairs || f.tiles > kMostPairs || v.count > 65535)
    throw std::invalid_argument(
        "too many views, pixels or pairs of surfel and tile for one call: draw fewer views at "
        "once, or smaller ones");
  return f;
}
}  // namespace

void baked_bin(const BakedFrame& f, Stream stream) {
  fill_zero(reinterpret_cast<char*>(f.memory.total), f.memory.cleared, stream);
  int owned = kThreads;
  while (owned > kLeastOwned && ceil_div(f.rows, owned) < kLeastBlocks) owned /= 2;
  const dim3 blocks(unsigned(ceil_div(f.rows, owned)));
  with_kernel(f.through_pixel, [&](auto kernel) {
    BT_LAUNCH(pairs_kernel<decltype(kernel)>, blocks, dim3(kThreads), 0, stream, f, owned);
    const unsigned large = unsigned(min_<int64_t>(kLargeBlocks, ceil_div(f.rows * kLargeParts, kWarps)));
    BT_LAUNCH(large_pairs_kernel<decltype(kernel)>, dim3(large), dim3(kThreads), 0, stream, f);
  });
  BT_LAUNCH(ranges_kernel, dim3(unsigned(ceil_div(f.tiles, kThreads))), dim3(kThreads), 0, stream, f);
  const unsigned moves = unsigned(ceil_div(f.capacity, kThreads * kMoved));
  BT_LAUNCH(places_kernel, dim3(moves), dim3(kThreads), 0, stream, f);
  baked_sort(f, stream);
}

size_t baked_memory(int64_t surfels, const BakedViews& views, int64_t capacity, bool normals) {
  BakedFrame f = frame_of(surfels, views, capacity);
  return lay_out(f, nullptr, normals);
}

void baked_frame(const BakedDraw& a, Stream stream) {
  BakedFrame f = frame_of(a.scene->geometry.n, a.views, a.capacity);
  f.through_pixel = a.scene->through_pixel, f.photo_pixel = a.photo_pixel;
  const int64_t needed = lay_out(f, a.memory.at, a.images.normal != nullptr);
  if (a.memory.bytes < needed)
    throw std::invalid_argument("the working memory has " + std::to_string(a.memory.bytes) +
                                " bytes, the frame needs " + std::to_string(needed));
  if (f.rows) {
    if (a.stages & kPrepare) baked_prepare(*a.scene, a.views, f, stream);
    if (a.stages & kBin) baked_bin(f, stream);
  }
  if (a.stages & kDraw) baked_draw(*a.scene, a.images, f, stream);
}

}  // namespace bt::cuda
