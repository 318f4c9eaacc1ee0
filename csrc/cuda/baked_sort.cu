// The last step of the baked renderer's second stage: every tile's list front to back.
//
// A warp sorts a short list in registers (a bitonic network). A longer one is sorted by the block: each warp sorts a
// part, the parts meet in shared memory, and every key finds its place as its number in its own part and how many keys
// of the others are below it. Lists longer than that room are sorted in runs, which are merged two by two through
// global memory. Keys hold the depth and the surfel's row, so no two are alike and the order does not depend on who
// wrote first.
#include "cuda/baked_stages.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128, kTiles = kThreads / kWarp;  // of a block
constexpr int kMostOfWarp = 4 * kWarp;                    // keys that a warp sorts by itself
constexpr int kMostPerLane = 8;
constexpr int kRun = kThreads * kMostPerLane;  // keys that a block sorts at once

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

// Sorts n <= kWarp * K pairs within a warp.
template <int K>
__device__ void sort_short(const BakedMemory& m, uint32_t* pairs, int n) {
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

// Sorts the list from `begin` on within a block.
__device__ void sort_long(const BakedMemory& m, int begin, int n, Key* shared) {
  uint32_t* pairs = m.pairs + begin;
  if (n <= kRun) {
    sort_run(n, shared, [&](int i) { return key_of(m, pairs[i]); }, [&](int i, Key key) { pairs[i] = uint32_t(key); });
    return;
  }
  Key *keys = m.keys + begin, *merged = m.merged + begin;
  for (int run = 0; run < n; run += kRun) {
    sort_run(
        min_(kRun, n - run), shared, [&](int i) { return key_of(m, pairs[run + i]); },
        [&](int i, Key key) { keys[run + i] = key; });
    __syncthreads();
  }
  for (int64_t run = kRun; run < n; run *= 2) {
    for (int i = threadIdx.x; i < n; i += kThreads) {
      const int own = int(i / run * run), both = int(i / (2 * run) * (2 * run));
      const int other = int(own == both ? min_<int64_t>(both + run, n) : both);
      const Key key = keys[i];
      merged[both + (i - own) + below(keys + other, int(min_<int64_t>(run, n - other)), key)] = key;
    }
    __syncthreads();
    Key* swap = keys;
    keys = merged, merged = swap;
  }
  for (int i = threadIdx.x; i < n; i += kThreads) pairs[i] = uint32_t(keys[i]);
}

__global__ void __launch_bounds__(kThreads, 10) sort_kernel(BakedFrame f) {
  __shared__ Key shared[kRun];
  const BakedMemory& m = f.memory;
  const int64_t first = int64_t(blockIdx.x) * kTiles;
  const auto range_of = [&](int64_t tile, int& begin) {
    begin = tile < f.tiles ? m.ranges[2 * tile] : 0;
    return tile < f.tiles ? m.ranges[2 * tile + 1] - begin : 0;
  };
  int begin = 0, n = range_of(first + threadIdx.x / kWarp, begin);
  if (n <= kWarp)
    sort_short<1>(m, m.pairs + begin, n);
  else if (n <= 2 * kWarp)
    sort_short<2>(m, m.pairs + begin, n);
  else if (n <= kMostOfWarp)
    sort_short<4>(m, m.pairs + begin, n);
  for (int64_t tile = first; tile < first + kTiles; ++tile) {
    n = range_of(tile, begin);
    if (n <= kMostOfWarp) continue;
    sort_long(m, begin, n, shared);
    __syncthreads();
  }
}
}  // namespace

void baked_sort(const BakedFrame& f, Stream stream) {
  BT_LAUNCH(sort_kernel, dim3(unsigned(ceil_div(f.tiles, kTiles))), dim3(kThreads), 0, stream, f);
}

}  // namespace bt::cuda
