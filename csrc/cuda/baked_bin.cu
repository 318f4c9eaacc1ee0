// Second stage of the baked renderer: every tile's surfels, and the host's side of a frame.
//
// No sort runs over all surfels or all pairs, and tiles are found once. A block lists the pairs of its surfels: each
// draws its number within its tile from the tile's counter, and is written to the tile's slot of this number. Pairs
// that find no slot go to one list of all tiles. Each tile's list is sorted where the tile is drawn (baked_sort.h). In
// which order pairs came has no influence on the image.
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
constexpr int kLarge = 128;             // tiles from which on a surfel is left to `large_pairs_kernel`
constexpr int kLargeParts = 16;         // in which such a surfel's rows of tiles are shared out
constexpr int kLargeBlocks = 528;       // four for each multiprocessor of a large card
constexpr int kLong = 2;                // times the mean for which there is room: a list that is long,
constexpr int kLeastLong = 128;         // but not with fewer pairs than this

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
    if (me == 0 && pairs > 0) add_to(m.total, pairs);
    __syncthreads();
    for (int k = me; k < pairs; k += kThreads) {
      const int of = last_at_most(first_pair, taken, k), right = k - first_pair[of];
      list_pair(f, row_id[of], row_tile[of] + uint32_t(right), part_mask(row[of], row[of].left + right));
    }
    __syncthreads();
  }
}

// Lists a row of tiles of a surfel without a box, of which lanes take a tile each. Returns how many.
template <class Kernel>
__device__ int list_reached(const BakedFrame& f, uint32_t r, int ty, int lane) {
  const float* row = f.memory.rows + int64_t(r) * kRow;
  const uint32_t tile = first_tile(f, r, ty);
  int listed = 0;
  for (int first = 0; first < f.tiles_x; first += kWarp) {
    const int tx = first + lane;
    const uint32_t parts = tx < f.tiles_x ? reached_parts<Kernel>(row, tx, ty) : 0;
    listed += __popc(__ballot_sync(kFullMask, parts != 0));
    if (parts) list_pair(f, r, tile + uint32_t(tx), parts);
  }
  return listed;
}

// The surfels of many tiles and those without a box, a warp to a share of the rows of tiles of one.
template <class Kernel>
__global__ void __launch_bounds__(kThreads, 4) large_pairs_kernel(BakedFrame f) {
  const BakedMemory& m = f.memory;
  const int lane = threadIdx.x % kWarp, warps = int(gridDim.x) * kWarps;
  const int64_t shares = int64_t(*m.large_count) * kLargeParts;
  int64_t listed = 0;
  for (int64_t i = int64_t(blockIdx.x) * kWarps + threadIdx.x / kWarp; i < shares; i += warps) {
    const uint32_t r = m.large[i / kLargeParts];
    const Footprint of = footprint<Kernel>(m.rows + int64_t(r) * kRow, f.width, f.height);
    for (int ty = of.top + int(i % kLargeParts); ty <= of.bottom; ty += kLargeParts) {
      if (of.bounds.whole) {
        listed += list_reached<Kernel>(f, r, ty, lane);
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

// Cuts the working memory into its arrays; the bytes needed. With a null base only the bytes count.
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
  // indices of pairs have 32 bits
  if (f.capacity > kMostPairs || f.tiles > kMostPairs / slots || v.count > 65535)
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
}

size_t baked_memory(int64_t surfels, const BakedViews& views, int slots, int64_t capacity, bool normals) {
  BakedFrame f = frame_of(surfels, views, slots, capacity);
  return lay_out(f, nullptr, normals);
}

void baked_frame(const BakedDraw& a, Stream stream) {
  BakedFrame f = frame_of(a.scene->geometry.n, a.views, a.slots, a.capacity);
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
