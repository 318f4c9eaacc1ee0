// Pairs of surfel and screen tile of the baked renderer: how they are found and stored.
//
// There is no sort over all surfels or pairs, and tiles are found once. A pair takes the next slot of its tile,
// by the tile's counter; when the slots are full, it goes to one list of all tiles. Each tile's list is sorted when the
// tile is drawn (baked_sort.h), so the image does not depend on the order of insertion.
#pragma once

#include "cuda/baked_stages.h"
#include "cuda/warp.h"

namespace bt::cuda {

constexpr int kListThreads = 128, kListWarps = kListThreads / kWarp;
constexpr int kLarge = 128;  // tiles from which a surfel is handled by `large_pairs_kernel`

namespace {
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

}  // namespace

}  // namespace bt::cuda
