// Second stage of the baked renderer: every tile's surfels front to back, and the host's side of a frame.
//
// No sort runs over all surfels or all pairs, and tiles are found once. A block lists the pairs of its surfels, at a
// place in the list that it draws from one counter; each pair draws its number within its tile from the tile's counter.
// Every tile then takes its range of the lists, the pairs move there, and each tile's list is sorted for itself
// (baked_sort.cu). Where ranges lie and in which order pairs came has no influence on the image.
#include <stdexcept>
#include <string>

#include "cuda/baked_stages.h"
#include "cuda/workspace.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128, kWarps = kThreads / kWarp;
constexpr int64_t kLeastBlocks = 1024;  // where there are fewer a block takes fewer surfels,
constexpr int kLeastOwned = 4;          // but as many as this
constexpr int kMoved = 4;               // pairs that a thread moves

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

// Threads take a surfel each, then a row of tiles each, then a pair each, so that all are busy and neighbours write to
// neighbouring places however many rows a surfel has and however wide they are. A block takes `owned` surfels.
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
    const Footprint of = footprint<Kernel>(m.rows + r * kRow, f.height);
    footprint_in(area[me]) = of;
    mine = of.bottom - of.top + 1;
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
      row_tile[me] =
          row_id[me] / uint32_t(f.n) * uint32_t(f.tiles_x * f.tiles_y) + uint32_t(ty * f.tiles_x + mine.left);
    }
    first_pair[me] = block_sum_before(width, sums, pairs);
    if (me == 0 && pairs > 0)
      place =
          int64_t(atomicAdd(reinterpret_cast<unsigned long long*>(m.total), static_cast<unsigned long long>(pairs)));
    __syncthreads();
    for (int k = me; k < pairs; k += kThreads) {
      const int64_t at = place + k;
      if (at >= f.capacity) break;
      const int of = last_at_most(first_pair, taken, k), right = k - first_pair[of];
      const uint32_t tile = row_tile[of] + uint32_t(right);
      const int32_t number = atomicAdd(m.ranges + 2 * int64_t(tile) + 1, 1);
      m.listed_tile[at] = tile;
      m.listed_pair[at] = row_id[of] << 8 | part_mask(row[of], row[of].left + right);
      m.listed_number[at] = number;
    }
    __syncthreads();
  }
}

// From the number of a tile's pairs to where they begin and end.
__global__ void __launch_bounds__(kThreads) ranges_kernel(BakedFrame f) {
  const int64_t tile = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = threadIdx.x % kWarp;
  int32_t* range = f.memory.ranges + 2 * tile;
  const int count = tile < f.tiles ? range[1] : 0;
  const int before = warp_sum_before(count, lane);
  int32_t begin = 0;
  if (lane == kWarp - 1) begin = atomicAdd(f.memory.given, before + count);
  begin = __shfl_sync(kFullMask, begin, kWarp - 1) + before;
  if (tile < f.tiles) range[0] = begin, range[1] = begin + count;
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
  m.total = arena.take<int64_t>(2), m.given = reinterpret_cast<int32_t*>(m.total + 1);
  m.ranges = arena.take<int32_t>(2 * f.tiles);
  m.cleared = arena.used();
  m.rows = arena.take<float>(f.rows * kRow);
  m.normals = normals ? arena.take<float4>(f.rows) : nullptr;
  m.depth = arena.take<uint32_t>(f.rows);
  m.pairs = arena.take<uint32_t>(f.capacity);
  m.keys = arena.take<uint64_t>(f.capacity), m.merged = arena.take<uint64_t>(f.capacity);
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
