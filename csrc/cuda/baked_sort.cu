// The last step of the baked renderer's second stage: every tile's list front to back.
//
// A warp first collects what its tile's slots had no room for. It sorts a short list in registers (a bitonic network).
// A longer one is sorted by the block: each warp sorts a part, the parts meet in shared memory, and every key finds its
// place as its number in its own part and how many keys of the others are below it. Lists longer than that room are
// sorted in runs, which are then merged two by two where they stand. Keys hold the depth and the surfel's row, so no
// two are alike and the order does not depend on who wrote first.
#include "cuda/baked_stages.h"
#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128, kTiles = kThreads / kWarp;  // of a block
constexpr int kMostOfWarp = 4 * kWarp;                    // keys that a warp sorts by itself
constexpr int kMostPerLane = 8;
constexpr int kRun = kThreads * kMostPerLane;  // keys that a block sorts at once
constexpr int kHalf = kRun / 2;                // of two runs that it merges at once
constexpr int kLong = 2;                       // times the mean of all tiles: a list that is long

using Key = uint64_t;  // depth << 32 | pair
constexpr Key kNone = ~Key(0);

// Sorts the warp's keys: the one numbered lane * K + k is in key[k].
template <int K>
__device__ void sort_warp(Key (&key)[K], int lane) {
  for (int size = 2; size <= kWarp * K; size *= 2) {  // parts of so many keys, rising and falling in turn, are merged
    for (int by = size / 2; by >= K; by /= 2) {
      const bool rising = !(lane * K & size), keep_low = !(lane * K & by) == rising;
      BT_UNROLL
      for (int k = 0; k < K; ++k) {
        const Key other = __shfl_xor_sync(kFullMask, key[k], by / K);
        if ((other < key[k]) == keep_low) key[k] = other;
      }
    }
    BT_UNROLL
    for (int by = K / 2; by > 0; by /= 2) {
      if (by >= size) continue;
      BT_UNROLL
      for (int k = 0; k < K; ++k) {
        if (k & by) continue;
        const bool rising = !((lane * K + k) & size);
        const Key a = key[k], b = key[k + by];
        const bool swap = (b < a) == rising;
        key[k] = swap ? b : a, key[k + by] = swap ? a : b;
      }
    }
  }
}

// How many of `count` ascending keys are below `key`.
__device__ int below(const Key* keys, int count, Key key) {
  int low = 0;
  for (int high = count; low < high;) {
    const int middle = (low + high) / 2;
    if (keys[middle] < key)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

// Sorts n <= kThreads * K keys through `shared`, which has room for so many: get(i) gives one, put(i, key) takes it at
// its place. All threads of the block take part.
template <int K, class Get, class Put>
__device__ void sort_run(int n, Key* shared, Get get, Put put) {
  constexpr int kPart = kWarp * K;
  const int lane = threadIdx.x % kWarp, from = int(threadIdx.x) / kWarp * kPart;
  if (from < n) {
    Key key[K];
    BT_UNROLL
    for (int k = 0; k < K; ++k) {
      const int i = from + k * kWarp + lane;
      key[k] = i < n ? get(i) : kNone;
    }
    sort_warp<K>(key, lane);
    BT_UNROLL
    for (int k = 0; k < K; ++k) shared[from + lane * K + k] = key[k];
  }
  __syncthreads();
  for (int i = threadIdx.x; i < n; i += kThreads) {
    const Key key = shared[i];
    int at = i % kPart;
    for (int part = 0; part < n; part += kPart)
      if (part != i - i % kPart) at += below(shared + part, min_(kPart, n - part), key);
    put(at, key);
  }
}
template <class Get, class Put>
__device__ void sort_run(int n, Key* shared, Get get, Put put) {
  if (n <= 2 * kThreads)
    sort_run<2>(n, shared, get, put);
  else if (n <= 4 * kThreads)
    sort_run<4>(n, shared, get, put);
  else
    sort_run<kMostPerLane>(n, shared, get, put);
}

__device__ Key key_of(const BakedMemory& m, uint32_t pair) { return Key(m.depth[pair >> 8]) << 32 | pair; }

// A tile's pairs, in its slots and behind those of all tiles.
struct PairsOfTile {
  uint32_t *slots, *rest;
  int slot_count;
  __device__ uint32_t& operator[](int i) const { return (i < slot_count ? slots : rest)[i]; }
};
__device__ PairsOfTile pairs_of(const BakedFrame& f, int64_t tile) {
  const BakedMemory& m = f.memory;
  return {m.pairs + tile * f.slots, m.pairs + m.lists[tile].rest, f.slots};
}

// Writes the pairs of a tile's chains one after the other. Of a frame that does not fit some are missing.
__device__ void collect_spilled(const BakedFrame& f, int64_t tile, int lane) {
  const BakedMemory& m = f.memory;
  TileList& list = m.lists[tile];
  const int count = list.count - f.slots;
  int64_t begin = lane == 0 ? add_to(m.rest_count, count) : 0;
  begin = __shfl_sync(kFullMask, begin, 0);
  const int room = int(max_<int64_t>(min_<int64_t>(f.capacity - begin, count), 0));
  uint32_t* to = m.pairs + f.tiles * f.slots + begin;
  uint32_t at = lane < kChains ? list.chains[lane] : 0;
  int found = 0;
  while (const unsigned going = __ballot_sync(kFullMask, at != 0)) {
    const int i = found + count_below(going, lane);
    if (at) {
      const SpilledPair spilled = m.spilled[at - 1];
      if (i < room) to[i] = spilled.pair;
      at = spilled.before;
    }
    found += __popc(going);
  }
  if (lane == 0) {
    list.rest = uint32_t((f.tiles - 1) * f.slots + begin);
    list.count = f.slots + min_(found, room);
  }
  __syncwarp();
}

// Sorts n <= kWarp * K pairs within a warp.
template <int K>
__device__ void sort_short(const BakedMemory& m, const PairsOfTile& pairs, int n) {
  if (n < 2) return;
  const int lane = threadIdx.x % kWarp;
  Key key[K];
  BT_UNROLL
  for (int k = 0; k < K; ++k) key[k] = k * kWarp + lane < n ? key_of(m, pairs[k * kWarp + lane]) : kNone;
  sort_warp<K>(key, lane);
  BT_UNROLL
  for (int k = 0; k < K; ++k)
    if (lane * K + k < n) pairs[lane * K + k] = uint32_t(key[k]);
}

// Of two sorted runs, of kHalf pairs and of n, the lower ones go to the first. All threads of the block take part.
__device__ void merge(const BakedMemory& m, const PairsOfTile& pairs, int first, int second, int n, Key* shared) {
  const auto index = [&](int i) { return i < kHalf ? first + i : second + i - kHalf; };
  for (int i = threadIdx.x; i < kHalf + n; i += kThreads) shared[i] = key_of(m, pairs[index(i)]);
  __syncthreads();
  for (int i = threadIdx.x; i < kHalf + n; i += kThreads) {
    const Key key = shared[i];
    const int at = i < kHalf ? i + below(shared + kHalf, n, key) : i - kHalf + below(shared, kHalf, key);
    pairs[index(at)] = uint32_t(key);
  }
  __syncthreads();
}

// Sorts a list within a block. Runs are merged as Batcher's network compares numbers: in an order that does not depend
// on them and where they stand, with no more memory than `shared`.
__device__ void sort_long(const BakedMemory& m, const PairsOfTile& pairs, int n, Key* shared) {
  for (int run = 0; run < n; run += kRun) {
    sort_run(
        min_(kRun, n - run), shared, [&](int i) { return key_of(m, pairs[run + i]); },
        [&](int i, Key key) { pairs[run + i] = uint32_t(key); });
    __syncthreads();
  }
  const int runs = int(ceil_div(n, kHalf));
  for (int sorted = 2; sorted < runs; sorted *= 2)  // so many runs stand in order
    for (int apart = sorted; apart > 0; apart /= 2)
      for (int run = apart % sorted; run + apart < runs; ++run)
        if ((run - apart % sorted) / apart % 2 == 0 && run / (2 * sorted) == (run + apart) / (2 * sorted))
          merge(m, pairs, run * kHalf, (run + apart) * kHalf, min_(n - (run + apart) * kHalf, kHalf), shared);
}

// Tiles of long lists are drawn first, so that none of them is left when all others are done.
__device__ void put_in_order(const BakedFrame& f, int64_t first) {
  const BakedMemory& m = f.memory;
  const int lane = threadIdx.x % kWarp;
  const int64_t tile = first + lane;
  const bool in = lane < kTiles && tile < f.tiles;
  const bool is_long = in && int64_t(m.lists[tile].count) * f.tiles > kLong * *m.total;
  const unsigned longs = __ballot_sync(kFullMask, is_long), others = __ballot_sync(kFullMask, in && !is_long);
  int32_t before = 0, after = 0;
  if (lane == 0) {
    if (longs) before = atomicAdd(m.long_tiles, __popc(longs));
    if (others) after = atomicAdd(m.other_tiles, __popc(others));
  }
  before = __shfl_sync(kFullMask, before, 0) + count_below(longs, lane);
  after = __shfl_sync(kFullMask, after, 0) + count_below(others, lane);
  if (in) m.order[is_long ? before : f.tiles - 1 - after] = uint32_t(tile);
}

__global__ void __launch_bounds__(kThreads, 10) sort_kernel(BakedFrame f) {
  __shared__ Key shared[kRun];
  const BakedMemory& m = f.memory;
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const int64_t first = int64_t(blockIdx.x) * kTiles, mine = first + warp;
  if (warp == 0) put_in_order(f, first);
  __syncthreads();  // it reads counts that are changed below
  if (mine < f.tiles) {
    if (m.lists[mine].count > f.slots) collect_spilled(f, mine, lane);
    const PairsOfTile pairs = pairs_of(f, mine);
    const int n = m.lists[mine].count;
    if (n <= kWarp)
      sort_short<1>(m, pairs, n);
    else if (n <= 2 * kWarp)
      sort_short<2>(m, pairs, n);
    else if (n <= kMostOfWarp)
      sort_short<4>(m, pairs, n);
  }
  __syncthreads();
  for (int64_t tile = first; tile < min_(first + kTiles, f.tiles); ++tile) {
    const int n = m.lists[tile].count;
    if (n > kMostOfWarp) sort_long(m, pairs_of(f, tile), n, shared);
  }
}
}  // namespace

void baked_sort(const BakedFrame& f, Stream stream) {
  BT_LAUNCH(sort_kernel, dim3(unsigned(ceil_div(f.tiles, kTiles))), dim3(kThreads), 0, stream, f);
}

}  // namespace bt::cuda
