// Tile lists: the surfels that may touch each tile, front to back.
//
// Two sorts instead of one by a joint key of tile and depth: the n surfels by depth, then, written in that order, the
// pairs by tile alone. Both are stable, so a tile's pairs end up front to back, with ties in surfel order. With about
// six pairs per surfel, the large sort moves 8 bytes per pair through two passes (13 bits for 4,000 tiles) instead of
// 12 through six (45 bits), and depth keeps all its bits, in double as well.
#include "core/footprint.h"
#include "cuda/kernels.h"
#include "cuda/sort_scan.h"
#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;
constexpr int kAlone = 64;  // tiles that a thread lists alone; beyond, its warp helps

template <class S> struct CountSpace {
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

// Returns the bits of a tile's index; one past the last tile marks slots without a tile.
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

// Tiles that a surfel can touch.
template <class S> struct TouchedTiles {
  S row[kLevelRow];
  Footprint<S> of;
  int width, height;

  __device__ TouchedTiles(const View<S>& v, int64_t id) : width(v.width), height(v.height) {
    level_row<LowPassKernel>(v.geom + id * kGeom, v.near, S(1), row);
    of = footprint(row, width, height);
  }
  // True for a disc that crosses the camera's plane and has no box.
  __device__ bool boxless() const { return of.bounds.whole; }
  // Calls fn(row, first, last) for the rows of tiles of a surfel with a box.
  template <class F> __device__ void each_row(F&& fn) const {
    for (int ty = of.top; ty <= of.bottom; ++ty) {
      const TileRow tiles = tile_row(of, ty, width);
      if (tiles.left <= tiles.right) fn(ty, tiles.left, tiles.right);
    }
  }
  // Calls fn(votes, tile) by all lanes of a warp for the tiles reached by a surfel without a box: a tile per lane,
  // `votes` has the lanes whose tile is reached.
  template <class F> __device__ void each_reached(int lane, F&& fn) const {
    const int across = tiles_across(width), tiles = across * tiles_across(height);
    for (int first = 0; first < tiles; first += kWarp) {
      const int tile = first + lane, ty = tile / across;
      const unsigned votes = __ballot_sync(kFullMask, tile < tiles && reached_parts(row, tile - ty * across, ty) != 0);
      if (votes) fn(votes, tile);
    }
  }
};

template <class S> __global__ void __launch_bounds__(kThreads) count_kernel(View<S> v, CountSpace<S> w) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = int(threadIdx.x) % kWarp;
  const bool visible = i < v.n && v.radii[2 * i] > S(0);
  bool crosses = false;
  int64_t count = 0;
  if (visible) {
    const TouchedTiles<S> touched(v, i);
    crosses = touched.boxless();
    if (!crosses) touched.each_row([&](int, int first, int last) { count += last - first + 1; });
  }
  for (unsigned todo = __ballot_sync(kFullMask, crosses); todo;) {
    const int j = take_first(todo);
    int reached = 0;
    TouchedTiles<S>(v, i - lane + j).each_reached(lane, [&](unsigned votes, int) { reached += __popc(votes); });
    if (lane == j) count = reached;
  }
  if (i >= v.n) return;
  w.keys[i] = visible ? sort_key(v.geom[i * kGeom + kZ]) : ~typename SortKey<S>::type(0);
  w.rows[i] = int32_t(i);
  w.counts[i] = int32_t(count);  // at most the tiles of an image
}

// Gathers counts by rank, with one more entry for the total.
__global__ void __launch_bounds__(kThreads)
    rank_kernel(int64_t n, const int32_t* order, const int32_t* counts, int32_t* ranked) {
  const int64_t r = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (r <= n) ranked[r] = r < n ? counts[order[r]] : 0;
}

// Lists the pairs, one thread per surfel by rank; a warp lists large surfels together, so that a disc in front of the
// camera does not leave the whole screen to one thread. Counts come from another kernel, which may round differently
// (cmake/cuda.cmake prevents that for nvcc). In any case no thread writes past its slots, and slots without a tile
// become pairs after those of all tiles.
template <class S>
__global__ void __launch_bounds__(kThreads)
    list_kernel(View<S> v, const int32_t* order, const int64_t* slot_start, FillSpace w) {
  const int64_t r = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = int(threadIdx.x) % kWarp, across = tiles_across(v.width);
  const int64_t from = r < v.n ? slot_start[r] : 0, count = r < v.n ? slot_start[r + 1] - from : 0;
  const int32_t id = count ? order[r] : 0;
  const auto put = [&](int64_t slot, int tile, int32_t whose) {
    w.tile[slot] = uint32_t(tile);
    w.slots[slot] = int32_t(slot);
    w.owner[slot] = whose;
  };
  // lists the tiles of a box, this being thread `mine` of `step`; returns the next slot
  using Touched = TouchedTiles<S>;
  const auto list_box = [&](const Touched& touched, int32_t whose, int64_t at, int64_t end, int mine, int step) {
    touched.each_row([&](int row, int first, int last) {
      for (int column = first + mine; column <= last; column += step) {
        const int64_t slot = at + column - first;
        if (slot >= end) break;
        put(slot, row * across + column, whose);
      }
      at += last - first + 1;
    });
    return at;
  };
  const auto close = [&](int32_t whose, int64_t at, int64_t end, int mine, int step) {
    for (int64_t slot = at + mine; slot < end; slot += step) put(slot, across * tiles_across(v.height), whose);
  };
  bool by_warp = false;
  if (count) {
    const Touched touched(v, id);
    by_warp = count > kAlone || touched.boxless();
    if (!by_warp) close(id, list_box(touched, id, from, from + count, 0, 1), from + count, 0, 1);
  }
  for (unsigned todo = __ballot_sync(kFullMask, by_warp); todo;) {
    const int j = take_first(todo);
    const int32_t whose = __shfl_sync(kFullMask, id, j);
    int64_t at = __shfl_sync(kFullMask, from, j);
    const int64_t end = at + __shfl_sync(kFullMask, count, j);
    const Touched touched(v, whose);
    if (touched.boxless())
      touched.each_reached(lane, [&](unsigned votes, int tile) {
        const int64_t slot = at + count_below(votes, lane);
        if ((votes >> lane & 1u) && slot < end) put(slot, tile, whose);
        at += __popc(votes);
      });
    else
      at = list_box(touched, whose, at, end, lane, kWarp);
    close(whose, at, end, lane, kWarp);
  }
}

__global__ void __launch_bounds__(kThreads)
    owner_kernel(int64_t pairs, const int32_t* slot, const int32_t* owner, int32_t* surfel) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k < pairs) surfel[k] = owner[slot[k]];
}

// Finds the first pair of every tile by bisection, at the same cost for tiles without pairs.
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
}  // namespace

template <class S> int64_t bin_count_workspace(int64_t n) { return space_bytes<CountSpace<S>>(n); }
int64_t bin_fill_workspace(int64_t pairs, int width, int height) {
  return space_bytes<FillSpace>(pairs, tiles_of(width, height));
}

template <class S> void bin_count(const BinCount<S>& a, Stream stream) {
  const View<S>& v = a.view;
  const int64_t n = v.n;
  const CountSpace<S> w = cut_space<CountSpace<S>>(a.workspace, n);
  BT_LAUNCH_EACH(count_kernel<S>, n, kThreads, stream, v, w);
  sort_pairs(w.keys, w.sorted, w.rows, a.order, n, CountSpace<S>::kBits, w.temp, w.temp_size, stream);
  BT_LAUNCH_EACH(rank_kernel, n + 1, kThreads, stream, n, a.order, w.counts, w.ranked);
  exclusive_sum(w.ranked, a.slot_start, n + 1, w.temp, w.temp_size, stream);
}

template <class S> void bin_fill(const BinFill<S>& a, Stream stream) {
  const View<S>& v = a.view;
  const int64_t pairs = a.pairs, tiles = tiles_of(v.width, v.height);
  const FillSpace w = cut_space<FillSpace>(a.workspace, pairs, tiles);
  if (pairs) {
    BT_LAUNCH_EACH(list_kernel<S>, v.n, kThreads, stream, v, a.order, a.slot_start, w);
    sort_pairs(w.tile, w.sorted, w.slots, a.slot, pairs, tile_bits(tiles), w.temp, w.temp_size, stream);
    BT_LAUNCH_EACH(owner_kernel, pairs, kThreads, stream, pairs, a.slot, w.owner, a.surfel);
  }
  BT_LAUNCH_EACH(range_kernel, tiles + 1, kThreads, stream, pairs, w.sorted, tiles, a.tile_pairs);
}

template int64_t bin_count_workspace<float>(int64_t);
template int64_t bin_count_workspace<double>(int64_t);
BT_INSTANTIATE(bin_count, BinCount)
BT_INSTANTIATE(bin_fill, BinFill)

}  // namespace bt::cuda
