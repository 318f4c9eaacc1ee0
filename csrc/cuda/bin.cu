// Tile lists: which surfels may touch which tiles, front to back.
//
// Two sorts instead of one by a joint key of tile and depth: the n surfels by depth, then, written out in that order,
// the pairs by tile alone. Both are stable, so a tile's pairs end front to back and equal depths keep the surfels'
// order. There are about six pairs per surfel: the large sort moves 8 bytes per pair through two passes (13 bits for
// 4,000 tiles) instead of 12 bytes through six (45 bits), and the depth enters with all its bits, in double as well.
#include "cuda/kernels.h"
#include "cuda/primitives.h"
#include "cuda/workspace.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;
constexpr int kAlone = 64;  // tiles that a thread lists by itself; beyond that its warp helps

template <class S>
struct CountSpace {
  using Key = typename SortKey<S>::type;
  static constexpr int kBits = 8 * sizeof(Key);
  Key *keys, *sorted;
  int32_t *rows, *counts, *ranked;
  int64_t temp_size;
  void* temp;
  CountSpace(Arena& arena, int64_t n)
      : keys(arena.take<Key>(n)),
        sorted(arena.take<Key>(n)),
        rows(arena.take<int32_t>(n)),
        counts(arena.take<int32_t>(n)),
        ranked(arena.take<int32_t>(n + 1)) {
    const int64_t sort = sort_workspace<Key>(n, kBits), scan = scan_workspace(n + 1);
    temp_size = sort > scan ? sort : scan;
    temp = arena.take<char>(temp_size);
  }
};

// Bits that tell the tiles apart, and the number behind the last.
int tile_bits(int64_t tiles) {
  int bits = 1;
  while ((int64_t(1) << bits) <= tiles) ++bits;
  return bits;
}
struct FillSpace {
  uint32_t *tile, *sorted;
  int32_t *slots, *owner;
  int64_t temp_size;
  void* temp;
  FillSpace(Arena& arena, int64_t pairs, int64_t tiles)
      : tile(arena.take<uint32_t>(pairs)),
        sorted(arena.take<uint32_t>(pairs)),
        slots(arena.take<int32_t>(pairs)),
        owner(arena.take<int32_t>(pairs)),
        temp_size(sort_workspace<uint32_t>(pairs, tile_bits(tiles))),
        temp(arena.take<char>(temp_size)) {}
};

template <class Kernel, class S>
__global__ void __launch_bounds__(kThreads)
    count_kernel(int64_t n, const S* geom, const S* radii, int width, int height, CountSpace<S> w) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  const bool visible = radii[2 * i] > S(0);
  int64_t count = 0;
  if (visible)
    for_tile_rows(extent<Kernel>(geom + i * kGeom), geom + i * kGeom, width, height,
                  [&](int, int first, int last) { count += last - first + 1; });
  w.keys[i] = visible ? sort_key(geom[i * kGeom + kZ]) : ~typename SortKey<S>::type(0);
  w.rows[i] = int32_t(i);
  w.counts[i] = int32_t(count);  // at most the tiles of an image
}

// counts by rank; one more entry for the total
__global__ void __launch_bounds__(kThreads)
    rank_kernel(int64_t n, const int32_t* order, const int32_t* counts, int32_t* ranked) {
  const int64_t r = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (r <= n) ranked[r] = r < n ? counts[order[r]] : 0;
}

// One thread per surfel, by rank; a warp lists its large surfels together, so that one disc before the camera does not
// keep a thread busy with the whole screen. The count comes from another kernel, and one formula may be rounded in two
// ways (cmake/cuda.cmake keeps nvcc from it). Whatever was counted: nobody writes beyond the slots of his surfel, a
// slot without a tile is a pair behind those of all tiles, and the difference is noted.
template <class Kernel, class S>
__global__ void __launch_bounds__(kThreads)
    list_kernel(int64_t n, const S* geom, int width, int height, const int32_t* order, const int64_t* slot_start,
                FillSpace w, int32_t* differing) {
  const int64_t r = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = int(threadIdx.x) % kWarp, across = tiles_across(width);
  const int64_t from = r < n ? slot_start[r] : 0, count = r < n ? slot_start[r + 1] - from : 0;
  const auto list = [&](int32_t id, int64_t at, int64_t end, int mine, int step) {
    const S* g = geom + int64_t(id) * kGeom;
    for_tile_rows(extent<Kernel>(g), g, width, height, [&](int row, int first, int last) {
      for (int column = first + mine; column <= last; column += step) {
        const int64_t slot = at + column - first;
        if (slot >= end) break;
        w.tile[slot] = uint32_t(row * across + column);
        w.slots[slot] = int32_t(slot);
        w.owner[slot] = id;
      }
      at += last - first + 1;
    });
    if (at != end && mine == 0) atomicAdd(differing, int32_t(at < end ? end - at : at - end));
    for (int64_t slot = at + mine; slot < end; slot += step) {
      w.tile[slot] = uint32_t(across * tiles_across(height));
      w.slots[slot] = int32_t(slot);
      w.owner[slot] = id;
    }
  };
  const int32_t id = count ? order[r] : 0;
  if (count && count <= kAlone) list(id, from, from + count, 0, 1);
  unsigned large = __ballot_sync(kFullMask, count > kAlone);
  while (large) {
    const int j = __ffs(int(large)) - 1;
    large &= large - 1;
    const int32_t whose = __shfl_sync(kFullMask, id, j);
    const int64_t at = __shfl_sync(kFullMask, from, j);
    list(whose, at, at + __shfl_sync(kFullMask, count, j), lane, kWarp);
  }
}

__global__ void __launch_bounds__(kThreads)
    owner_kernel(int64_t pairs, const int32_t* slot, const int32_t* owner, int32_t* surfel) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k < pairs) surfel[k] = owner[slot[k]];
}

// The first pair of every tile, by bisection: a tile without pairs costs no more than others.
__global__ void __launch_bounds__(kThreads)
    range_kernel(int64_t pairs, const uint32_t* tile, int64_t tiles, int64_t* tile_pairs) {
  const int64_t t = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (t > tiles) return;
  int64_t low = 0, high = pairs;
  while (low < high) {
    const int64_t mid = (low + high) / 2;
    if (int64_t(tile[mid]) < t)
      low = mid + 1;
    else
      high = mid;
  }
  tile_pairs[t] = low;
}

dim3 blocks(int64_t threads) { return dim3(unsigned(ceil_div(threads, kThreads))); }
}  // namespace

template <class S>
int64_t bin_count_workspace(int64_t n) {
  Arena arena(nullptr);
  const CountSpace<S> w(arena, n);
  return arena.used();
}
int64_t bin_fill_workspace(int64_t pairs, int width, int height) {
  Arena arena(nullptr);
  const FillSpace w(arena, pairs, tiles_of(width, height));
  return arena.used();
}

template <class S>
void bin_count(const BinCount<S>& a, Stream stream) {
  const View<S>& v = a.view;
  const int64_t n = v.n;
  Arena arena(a.workspace.of(bin_count_workspace<S>(n)));
  const CountSpace<S> w(arena, n);
  if (n)
    with_kernel(v.through_pixel, [&](auto kernel) {
      BT_LAUNCH((count_kernel<decltype(kernel), S>), blocks(n), dim3(kThreads), 0, stream, n, v.geom, v.radii, v.width,
                v.height, w);
    });
  sort_pairs(w.keys, w.sorted, w.rows, a.order, n, CountSpace<S>::kBits, w.temp, w.temp_size, stream);
  BT_LAUNCH(rank_kernel, blocks(n + 1), dim3(kThreads), 0, stream, n, a.order, w.counts, w.ranked);
  exclusive_sum(w.ranked, a.slot_start, n + 1, w.temp, w.temp_size, stream);
}

template <class S>
void bin_fill(const BinFill<S>& a, Stream stream) {
  const View<S>& v = a.view;
  const int64_t pairs = a.pairs, tiles = tiles_of(v.width, v.height);
  Arena arena(a.workspace.of(bin_fill_workspace(pairs, v.width, v.height)));
  const FillSpace w(arena, pairs, tiles);
  fill_zero(a.differing, 1, stream);
  if (pairs) {
    with_kernel(v.through_pixel, [&](auto kernel) {
      BT_LAUNCH((list_kernel<decltype(kernel), S>), blocks(v.n), dim3(kThreads), 0, stream, v.n, v.geom, v.width,
                v.height, a.order, a.slot_start, w, a.differing);
    });
    sort_pairs(w.tile, w.sorted, w.slots, a.slot, pairs, tile_bits(tiles), w.temp, w.temp_size, stream);
    BT_LAUNCH(owner_kernel, blocks(pairs), dim3(kThreads), 0, stream, pairs, a.slot, w.owner, a.surfel);
  }
  BT_LAUNCH(range_kernel, blocks(tiles + 1), dim3(kThreads), 0, stream, pairs, w.sorted, tiles, a.tile_pairs);
}

#define BT_INSTANTIATE(S)                              \
  template int64_t bin_count_workspace<S>(int64_t);    \
  template void bin_count(const BinCount<S>&, Stream); \
  template void bin_fill(const BinFill<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
