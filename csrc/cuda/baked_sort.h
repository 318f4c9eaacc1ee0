// Sorting of a screen tile's list front to back, by the block that draws it.
//
// A warp collects the pairs that had no slot. Then each warp sorts a part of the list in registers (bitonic network),
// the parts go to shared memory, and a key's position is its index in its own part plus the number of smaller keys in
// the others. Longer lists are sorted in runs, which are merged in pairs in place. Keys hold the depth and the surfel's
// row, so they are unique and the order is deterministic.
#pragma once

#include "cuda/baked_stages.h"
#include "cuda/warp.h"

namespace bt::cuda {

constexpr int kDrawThreads = 4 * kWarp;  // per block

namespace {
constexpr int kMostPerLane = 8;
constexpr int kRun = kDrawThreads * kMostPerLane;  // keys that a block sorts at once
constexpr int kHalf = kRun / 2;                    // keys of each run in a merge step

using Key = uint64_t;  // depth << 32 | pair
constexpr Key kNone = ~Key(0);

// Sorts the warp's keys: the one numbered lane * K + k is in key[k].
template <int K> __device__ void sort_warp(Key (&key)[K], int lane) {
  for (int size = 2; size <= kWarp * K; size *= 2) {  // merges parts of this size, alternately rising and falling
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

// Counts the keys below `key` among `count` ascending ones.
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

// Sorts n <= kDrawThreads * K keys through `shared`, which has room for as many: get(i) reads a key, put(i, key) writes
// position i. All threads of the block take part.
template <int K, class Get, class Put> __device__ void sort_run(int n, Key* shared, Get get, Put put) {
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
  for (int i = threadIdx.x; i < n; i += kDrawThreads) {
    const Key key = shared[i];
    int at = i % kPart;
    for (int part = 0; part < n; part += kPart)
      if (part != i - i % kPart) at += below(shared + part, min_(kPart, n - part), key);
    put(at, key);
  }
}
template <class Get, class Put> __device__ void sort_run(int n, Key* shared, Get get, Put put) {
  if (n <= kDrawThreads)
    sort_run<1>(n, shared, get, put);
  else if (n <= 2 * kDrawThreads)
    sort_run<2>(n, shared, get, put);
  else if (n <= 4 * kDrawThreads)
    sort_run<4>(n, shared, get, put);
  else
    sort_run<kMostPerLane>(n, shared, get, put);
}

__device__ Key key_of(const BakedMemory& m, uint32_t pair) { return Key(m.depth[pair >> 8]) << 32 | pair; }

// A tile's pairs: the first in its slots, the others collected behind the slots of all tiles, at rest[slot_count].
struct PairsOfTile {
  uint32_t *slots, *rest;
  int slot_count;
  __device__ uint32_t& operator[](int i) const { return (i < slot_count ? slots : rest)[i]; }
};

// Writes the pairs of a tile's chains contiguously. Some are missing in a frame that does not fit.
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
  if (lane == 0) list.rest = uint32_t((f.tiles - 1) * f.slots + begin), list.listed = f.slots + min_(found, room);
}

// Merges two sorted runs of kHalf and n pairs, lower keys to the first. All threads of the block take part.
__device__ void merge(const BakedMemory& m, const PairsOfTile& pairs, int first, int second, int n, Key* shared) {
  const auto index = [&](int i) { return i < kHalf ? first + i : second + i - kHalf; };
  for (int i = threadIdx.x; i < kHalf + n; i += kDrawThreads) shared[i] = key_of(m, pairs[index(i)]);
  __syncthreads();
  for (int i = threadIdx.x; i < kHalf + n; i += kDrawThreads) {
    const Key key = shared[i];
    const int at = i < kHalf ? i + below(shared + kHalf, n, key) : i - kHalf + below(shared, kHalf, key);
    pairs[index(at)] = uint32_t(key);
  }
  __syncthreads();
}

// Sorts n pairs. Runs are merged in place in the order of Batcher's network, which does not depend on the keys, using
// only `shared`.
__device__ void sort_pairs(const BakedMemory& m, const PairsOfTile& pairs, int n, Key* shared) {
  for (int run = 0; run < n; run += kRun) {
    sort_run(
        min_(kRun, n - run), shared, [&](int i) { return key_of(m, pairs[run + i]); },
        [&](int i, Key key) { pairs[run + i] = uint32_t(key); });
    __syncthreads();
  }
  const int runs = int(ceil_div(n, kHalf));
  for (int sorted = 2; sorted < runs; sorted *= 2)  // length of the sorted sequences, in runs
    for (int apart = sorted; apart > 0; apart /= 2)
      for (int run = apart % sorted; run + apart < runs; ++run)
        if ((run - apart % sorted) / apart % 2 == 0 && run / (2 * sorted) == (run + apart) / (2 * sorted))
          merge(m, pairs, run * kHalf, (run + apart) * kHalf, min_(n - (run + apart) * kHalf, kHalf), shared);
}

// Sorts a tile's list; returns its number of pairs. `shared` has room for kRun keys. All threads of the block take
// part.
__device__ int sort_list(const BakedFrame& f, int64_t tile, Key* shared) {
  const TileList& list = f.memory.lists[tile];
  int n = list.count;
  if (n > f.slots) {
    if (threadIdx.x < kWarp && !list.listed) collect_spilled(f, tile, threadIdx.x);
    __syncthreads();
    n = list.listed;
  }
  if (n > 1) sort_pairs(f.memory, {f.memory.pairs + tile * f.slots, f.memory.pairs + list.rest, f.slots}, n, shared);
  __syncthreads();
  return n;
}
}  // namespace

}  // namespace bt::cuda
