// Second stage of the baked renderer: every tile's surfels front to back, and the host's side of a frame.
//
// Two sorts instead of one: n keys of 32 bits (depth), then all pairs by 16 bits (tile), in two passes of 6 bytes each
// way. One sort of the pairs by tile and depth would take six passes of 12 bytes.
#include <stdexcept>
#include <string>

#include "cuda/baked_stages.h"
#include "cuda/primitives.h"
#include "cuda/workspace.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = kBlock;
constexpr int32_t kPairsAlone = 32;  // pairs that a thread writes by itself
constexpr int kRestPerThread = 16;
constexpr int64_t kLeastBlocks = 1024;  // where there are fewer a block takes fewer surfels,
constexpr int kLeastOwned = 4;          // but as many as this

__global__ void __launch_bounds__(kThreads) order_counts_kernel(BakedFrame f) {
  const int64_t r = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (r == 0) f.memory.total[1] = 0;
  if (r < f.rows) f.memory.ordered_counts[r] = f.memory.counts[f.memory.order[r]];
}

// The counts come from another kernel, and one formula may be rounded in two ways (cmake/cuda.cmake keeps nvcc from
// it). Whatever was counted: nobody writes beyond the places of his surfel, none of these stays unwritten, and the
// difference is noted.
__device__ void note_difference(const BakedFrame& f, int64_t listed, int64_t counted) {
  const int64_t difference = listed < counted ? counted - listed : listed - counted;
  if (difference)
    atomicAdd(reinterpret_cast<unsigned long long*>(f.memory.total + 1), static_cast<unsigned long long>(difference));
}

// Writes the pairs of one row of tiles from `at` on, never beyond `end`; the place after the last, were there no end.
template <class Key>
__device__ int64_t write_pairs(const TileRow& r, uint32_t first_tile, uint32_t row, int64_t at, int64_t end, Key* keys,
                               int32_t* values) {
  for (int tx = r.left; tx <= r.right && at + (tx - r.left) < end; ++tx) {
    keys[at + (tx - r.left)] = Key(first_tile + tx);
    values[at + (tx - r.left)] = int32_t(row << 8 | part_mask(r, tx));
  }
  return at + (r.right - r.left + 1);
}

// What a block shares: its large surfels, and the rows of tiles in hand.
struct LargeSurfels {
  FootprintRoom area[kThreads];
  int64_t start[kThreads], end[kThreads];  // places of a surfel's pairs
  uint32_t id[kThreads], base[kThreads];   // row; first tile of its view
  int first_row[kThreads];                 // rows of tiles before the surfel's
  int first_pair[kThreads], last_pair[kThreads];
  int32_t counted[kThreads];
  TileRow row[kThreads];
  int of[kThreads], ty[kThreads], before[kThreads];  // a row's surfel, its number, pairs before it
  int count, sums[kBlockWarps];
};

// All threads take a row of tiles each, then the pairs of these rows one after another, so that neighbours write to
// neighbouring places however wide or many the rows are.
template <class Key>
__device__ void write_large(const BakedFrame& f, LargeSurfels& s, Key* keys, int32_t* values) {
  const int me = threadIdx.x, large = s.count;
  int rows = 0, mine = 0;
  if (me < large) mine = footprint_in(s.area[me]).bottom - footprint_in(s.area[me]).top + 1;
  const int first = block_sum_before(mine, s.sums, rows);
  if (me < large) s.first_row[me] = first, s.first_pair[me] = s.last_pair[me] = 0;
  __syncthreads();
  int done = 0;  // pairs
  for (int next = 0; next < rows; next += kThreads) {
    const int taken = min_(rows - next, kThreads);
    int pairs = 0, width = 0, of = 0, ty = 0;
    if (me < taken) {
      of = last_at_most(s.first_row, large, next + me);
      const Footprint& area = footprint_in(s.area[of]);
      ty = area.top + (next + me - s.first_row[of]);
      s.row[me] = tile_row(area, ty, f.width);
      width = s.row[me].right - s.row[me].left + 1;
    }
    const int before = block_sum_before(width, s.sums, pairs);
    if (me < taken) {
      s.of[me] = of, s.ty[me] = ty, s.before[me] = before;
      if (ty == footprint_in(s.area[of]).top) s.first_pair[of] = done + before;
      if (ty == footprint_in(s.area[of]).bottom) s.last_pair[of] = done + before + width;
    }
    __syncthreads();
    for (int k = me; k < pairs; k += kThreads) {
      const int at_row = last_at_most(s.before, taken, k), surfel = s.of[at_row];
      const TileRow& row = s.row[at_row];
      const int tx = row.left + (k - s.before[at_row]);
      const int64_t at = s.start[surfel] + (done + k - s.first_pair[surfel]);
      if (at < s.end[surfel]) {
        keys[at] = Key(s.base[surfel] + uint32_t(s.ty[at_row] * f.tiles_x + tx));
        values[at] = int32_t(s.id[surfel] << 8 | part_mask(row, tx));
      }
    }
    __syncthreads();
    done += pairs;
  }
  if (me < large) {
    const int listed = s.last_pair[me] - s.first_pair[me];
    note_difference(f, listed, s.counted[me]);
    for (int64_t at = s.start[me] + listed; at < s.end[me]; ++at) keys[at] = Key(f.tiles);
  }
}

// The surfels in order of depth, `owned` per block: one thread each, the whole block for the large ones; the last
// blocks clear what is left over.
template <class Kernel, class Key>
__global__ void __launch_bounds__(kThreads) pairs_kernel(BakedFrame f, unsigned surfel_blocks, int owned) {
  __shared__ LargeSurfels large;
  Key* keys = static_cast<Key*>(f.memory.keys);
  int32_t* values = f.memory.values;
  if (blockIdx.x >= surfel_blocks) {
    const int64_t total = f.memory.offsets[f.rows - 1] + f.memory.ordered_counts[f.rows - 1];
    const int64_t me = int64_t(blockIdx.x - surfel_blocks) * kThreads + threadIdx.x;
    const int64_t stride = int64_t(gridDim.x - surfel_blocks) * kThreads;
    if (me == 0) *f.memory.total = total;
    for (int64_t k = total + me; k < f.capacity; k += stride) keys[k] = Key(f.tiles);
    for (int64_t k = me; k < 2 * f.tiles; k += stride) f.memory.ranges[k] = 0;
    return;
  }
  if (threadIdx.x == 0) large.count = 0;
  __syncthreads();
  const int64_t r = int64_t(blockIdx.x) * owned + threadIdx.x;
  const int32_t count = int(threadIdx.x) < owned && r < f.rows ? f.memory.ordered_counts[r] : 0;
  if (count > 0) {
    const uint32_t id = uint32_t(f.memory.order[r]);
    const int64_t from = f.memory.offsets[r], end = min_(from + int64_t(count), f.capacity);
    const Footprint area = footprint<Kernel>(f.memory.rows + int64_t(id) * kRow, f.height);
    const uint32_t base = id / uint32_t(f.n) * uint32_t(f.tiles_x * f.tiles_y);
    if (count <= kPairsAlone) {
      int64_t at = from;
      for (int ty = area.top; ty <= area.bottom; ++ty)
        at = write_pairs(tile_row(area, ty, f.width), base + ty * f.tiles_x, id, at, end, keys, values);
      note_difference(f, at - from, count);
      for (; at < end; ++at) keys[at] = Key(f.tiles);
    } else {
      const int k = atomicAdd(&large.count, 1);
      footprint_in(large.area[k]) = area;
      large.start[k] = from, large.end[k] = end, large.counted[k] = count;
      large.id[k] = id, large.base[k] = base;
    }
  }
  __syncthreads();
  if (large.count > 0) write_large(f, large, keys, values);
}

// Where each tile's pairs begin and end: one thread per run of keys as long as 16 bytes.
template <class Key>
__global__ void __launch_bounds__(kThreads) ranges_kernel(BakedFrame f) {
  constexpr int kKeys = 16 / sizeof(Key);
  const Key* keys = static_cast<const Key*>(f.memory.keys_sorted);
  const int64_t used = min_(*f.memory.total, f.capacity);
  const int64_t begin = (int64_t(blockIdx.x) * kThreads + threadIdx.x) * kKeys;
  if (begin >= used) return;
  Key mine[kKeys];
  memcpy(mine, __builtin_assume_aligned(keys + begin, 16), sizeof mine);
  int64_t before = begin ? int64_t(keys[begin - 1]) : -1;
  for (int k = 0; k < kKeys; ++k) {
    const int64_t at = begin + k;
    if (at >= used) break;
    const int64_t tile = mine[k];
    if (tile != before) {
      if (before >= 0) f.memory.ranges[2 * before + 1] = int32_t(at);
      if (tile < f.tiles) f.memory.ranges[2 * tile] = int32_t(at);
    }
    if (at == used - 1 && tile < f.tiles) f.memory.ranges[2 * tile + 1] = int32_t(at + 1);
    before = tile;
  }
}

template <class Key>
void bin(const BakedFrame& f, Stream stream) {
  const BakedMemory& m = f.memory;
  sort_pairs(m.depth, m.depth_sorted, m.unsorted, m.order, f.rows, 32, m.scratch, m.scratch_bytes, stream);
  const unsigned blocks = unsigned(ceil_div(f.rows, kThreads));
  BT_LAUNCH(order_counts_kernel, dim3(blocks), dim3(kThreads), 0, stream, f);
  exclusive_sum(m.ordered_counts, m.offsets, f.rows, m.scratch, m.scratch_bytes, stream);
  const unsigned rest = unsigned(min_<int64_t>(1024, ceil_div(f.capacity + 2 * f.tiles, kThreads * kRestPerThread)));
  int owned = kThreads;  // surfels per block
  while (owned > kLeastOwned && ceil_div(f.rows, owned) < kLeastBlocks) owned /= 2;
  const unsigned surfel_blocks = unsigned(ceil_div(f.rows, owned));
  with_kernel(f.through_pixel, [&](auto kernel) {
    BT_LAUNCH((pairs_kernel<decltype(kernel), Key>), dim3(surfel_blocks + rest), dim3(kThreads), 0, stream, f,
              surfel_blocks, owned);
  });
  sort_pairs(static_cast<const Key*>(m.keys), static_cast<Key*>(m.keys_sorted), m.values, m.values_sorted, f.capacity,
             f.key_bits, m.scratch, m.scratch_bytes, stream);
  const unsigned runs = unsigned(ceil_div(f.capacity, kThreads * int64_t(16 / sizeof(Key))));
  BT_LAUNCH(ranges_kernel<Key>, dim3(runs), dim3(kThreads), 0, stream, f);
}

// Cuts the working memory into its arrays; the bytes needed. With a null base only the bytes count.
int64_t lay_out(BakedFrame& f, void* base, bool normals) {
  Arena arena(base);
  BakedMemory& m = f.memory;
  m.total = arena.take<int64_t>(2);
  m.ranges = arena.take<int32_t>(2 * f.tiles);
  m.rows = arena.take<float>(f.rows * kRow);
  m.normals = normals ? arena.take<float4>(f.rows) : nullptr;
  m.depth = arena.take<uint32_t>(f.rows), m.depth_sorted = arena.take<uint32_t>(f.rows);
  m.unsorted = arena.take<int32_t>(f.rows), m.order = arena.take<int32_t>(f.rows);
  m.counts = arena.take<int32_t>(f.rows), m.ordered_counts = arena.take<int32_t>(f.rows);
  m.offsets = arena.take<int64_t>(f.rows);
  const int64_t key_bytes = f.capacity * (f.wide ? 4 : 2);
  m.keys = arena.take<char>(key_bytes), m.keys_sorted = arena.take<char>(key_bytes);
  m.values = arena.take<int32_t>(f.capacity), m.values_sorted = arena.take<int32_t>(f.capacity);
  m.scratch_bytes = 1;
  if (f.rows) {
    const int64_t pairs =
        f.wide ? sort_workspace<uint32_t>(f.capacity, f.key_bits) : sort_workspace<uint16_t>(f.capacity, f.key_bits);
    m.scratch_bytes = max_(max_(sort_workspace<uint32_t>(f.rows, 32), scan_workspace(f.rows)), pairs);
  }
  m.scratch = arena.take<char>(m.scratch_bytes);
  return arena.used();
}

BakedFrame frame_of(int64_t surfels, const BakedViews& v, int64_t capacity) {
  BakedFrame f = {};
  f.n = surfels, f.rows = surfels * v.count;
  f.width = v.width, f.height = v.height;
  f.tiles_x = tiles_across(v.width), f.tiles_y = tiles_across(v.height);
  f.tiles = int64_t(f.tiles_x) * f.tiles_y * v.count;
  f.capacity = ceil_div(max_<int64_t>(capacity, 1), 8) * 8;
  while (f.tiles >> f.key_bits) ++f.key_bits;
  f.wide = f.key_bits > 16;
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

void baked_bin(const BakedFrame& f, Stream stream) { f.wide ? bin<uint32_t>(f, stream) : bin<uint16_t>(f, stream); }

size_t baked_memory(int64_t surfels, const BakedViews& views, int64_t capacity, bool normals) {
  BakedFrame f = frame_of(surfels, views, capacity);
  return lay_out(f, nullptr, normals);
}

void baked_frame(const BakedDraw& a, Stream stream) {
  BakedFrame f = frame_of(a.scene->geometry.n, a.views, a.capacity);
  f.through_pixel = a.scene->through_pixel;
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
