// The fragment list of a view, and access to it.
//
// A pair is a surfel and a tile that it may touch. Pairs have two orders:
//   list order  by tile, then front to back, as the fragments. A pair's fragments are offsets[k] to offsets[k + 1] - 1,
//               a tile's pairs tile_pairs[tile] to tile_pairs[tile + 1] - 1.
//   slots       by surfel, front to back, then by tile. slot[k] is the slot of pair k; surfel order[r] has the slots
//               slot_start[r] to slot_start[r + 1] - 1. A kernel writes a pair's contribution to its surfel into the
//               pair's slot, and sum_slots adds a surfel's slots in order: no atomics, bitwise reproducible.
//
// A tile is a block of 8 warps, one warp per 8 x 4 pixels, one lane per pixel. masks[warp][k] has a bit for each pixel
// of the warp that blends pair k; a pair's fragments are ordered by warp, then by lane. So a fragment's offset is
// offsets[k] + the bits of lower warps + the bits of lower lanes, without a search.
#pragma once

#include "core/bounds.h"
#include "cuda/warp.h"
#include "ops/arguments.h"

namespace bt::cuda {

constexpr int kTileThreads = kTile * kTile, kTileWarps = kTileThreads / kWarp;
constexpr int kWarpWidth = 8, kWarpHeight = 4;

// Checks that pairs can be counted in 32 bits.
template <class R> void check_pairs(R& r, int64_t pairs) {
  if (pairs > INT32_MAX) r.refuse("more than 2^31 pairs of surfel and tile");
}

struct Pairs {
  int width, height;                      // of the image
  int64_t surfels, pairs;                 // counts
  const int32_t* surfel;                  // [pairs] list order
  const int32_t* slot;                    // [pairs] list order
  const uint32_t* masks;                  // [kTileWarps, pairs] list order
  const int64_t* offsets;                 // [pairs + 1] list order; null: fragments are not listed
  const int64_t* tile_pairs;              // [tiles + 1]
  const int32_t* order;                   // [surfels] front to back
  const int64_t* slot_start;              // [surfels + 1]
  int64_t fragments;                      // -1: not listed
  static constexpr bool kHasIds = false;  // kernels read them from the list
  int64_t tiles() const { return tiles_of(width, height); }
  bool fits(int64_t n, int wide, int high) const { return n == surfels && wide == width && high == height; }

  template <class R>  // as in ops/arguments.h
  void fields(R& r) {
    r.numbers("width", width, "height", height, "fragments", fragments);
    r.rows("surfel", surfel, pairs, 1);
    check_pairs(r, pairs);
    r.array("slot", slot, pairs);
    r.array("masks", masks, kTileWarps * pairs);
    r.maybe("offsets", offsets, pairs + 1);
    if (!offsets != (fragments < 0)) r.refuse("a list of fragments has offsets");
    r.array("tile_pairs", tile_pairs, tiles() + 1);
    r.rows("order", order, surfels, 1);
    r.array("slot_start", slot_start, surfels + 1);
  }
};

// Position of a thread in a tile's block.
struct TileThread {
  int warp, lane;
  int left, top;  // first pixel of the warp
  int x, y;       // the thread's pixel; may lie outside the image
};
__device__ inline TileThread tile_thread(int width) {
  TileThread s;
  s.warp = int(threadIdx.x) / kWarp, s.lane = int(threadIdx.x) % kWarp;
  const int across = tiles_across(width), tile = int(blockIdx.x);
  s.left = tile % across * kTile + s.warp % (kTile / kWarpWidth) * kWarpWidth;
  s.top = tile / across * kTile + s.warp / (kTile / kWarpWidth) * kWarpHeight;
  s.x = s.left + s.lane % kWarpWidth, s.y = s.top + s.lane / kWarpWidth;
  return s;
}

// Loads the first 12 columns of a row of geom with the widest loads, as all lanes of a warp read the same row.
constexpr int kShape = kBeta + 1;
template <class S> __device__ inline void load_shape(const S* row, S* g) {
#if defined(__CUDACC__)
  constexpr int kWide = 16 / sizeof(S);
  struct alignas(16) Wide {
    S v[kWide];
  };
#pragma unroll
  for (int i = 0; i < kShape / kWide; ++i) {
    const Wide w = reinterpret_cast<const Wide*>(row)[i];
#pragma unroll
    for (int k = 0; k < kWide; ++k) g[kWide * i + k] = w.v[k];
  }
#else
  for (int i = 0; i < kShape; ++i) g[i] = row[i];
#endif
}

// Rows of geom for up to 32 pairs, in shared memory.
template <class S> struct SurfelRows {
  struct alignas(16) Row {
    S g[kGeom];
  };
  Row rows[kWarp];
  int32_t ids[kWarp];

  // Loads the rows of surfel[begin] to surfel[end - 1], by all threads of a tile's block; a barrier must follow.
  __device__ void load(const S* geom, const int32_t* surfel, int begin, int end) {
    constexpr int kLoaders = kTileThreads / kWarp;  // threads per row
    static_assert(kGeom % kLoaders == 0);
    const int row = int(threadIdx.x) / kLoaders, column = int(threadIdx.x) % kLoaders;
    if (row < begin || row >= end) return;
    const int32_t id = surfel[row];
    if (column == 0) ids[row] = id;
    BT_UNROLL
    for (int c = 0; c < kGeom; c += kLoaders) rows[row].g[c + column] = geom[int64_t(id) * kGeom + c + column];
  }
};

// Writes the sums of a surfel's pairs: columns of geom, and in between the absolute gradients.
template <class S> struct StoreGeomGradient {
  S *dgeom, *absgrad;
  __device__ void operator()(int64_t surfel, int column, S sum) const {
    dgeom[surfel * kGeom + column] = column < kShape ? sum : S(0);
    if (column >= kShape && column < kShape + 2) absgrad[2 * surfel + column - kShape] = sum;
  }
};

// Visits the pairs of a tile that have a fragment in the calling warp, back to front. Every lane calls load(k, surfel,
// mine, i) and later use(result of load): `mine` is true if the lane's pixel has a fragment of pair k, i is its index
// in the list. kAhead loads are in flight before the first is used, as a warp has only about ten fragments of a pair.
// Warps do not wait for the block.
template <int kAhead, class Load, class Use>
__device__ inline void each_fragment_back(const Pairs& p, const TileThread& s, Load&& load, Use&& use) {
  const int64_t begin = p.tile_pairs[blockIdx.x], end = p.tile_pairs[blockIdx.x + 1];
  const int64_t batches = ceil_div(end - begin, kWarp);
  for (int64_t b = 0; b < batches; ++b) {
    // one lane per pair: masks, and first fragments of the warp
    const int64_t first = begin + kWarp * (batches - 1 - b), own = first + s.lane;
    uint32_t mark = 0;
    int32_t id = 0;
    int64_t from = 0;
    if (own < end && (mark = p.masks[s.warp * p.pairs + own])) {
      id = p.surfel[own], from = p.offsets[own];
      for (int w = 0; w < s.warp; ++w) from += __popc(p.masks[w * p.pairs + own]);
    }
    unsigned todo = __ballot_sync(kFullMask, mark != 0);
    while (todo) {
      decltype(load(first, id, true, from)) value[kAhead];
      BT_UNROLL
      for (int a = 0; a < kAhead; ++a) {
        const bool some = todo != 0;
        const int j = some ? take_last(todo) : 0;
        const unsigned taken = __shfl_sync(kFullMask, mark, j);
        const int64_t i = __shfl_sync(kFullMask, from, j) + count_below(taken, s.lane);
        value[a] = load(first + j, __shfl_sync(kFullMask, id, j), some && (taken >> s.lane & 1u), i);
      }
      BT_UNROLL
      for (int a = 0; a < kAhead; ++a) use(value[a]);
    }
  }
}

// A chunk of the list that a tile's block processes in shared memory: the next pairs, at most 32, with at most kHeld
// fragments. A warp has about ten fragments of a pair, a chunk some hundreds: all threads of the block read, compute or
// write them in sequence, and lanes find those of their pixels by the masks.
template <int kHeld> class Stretch {
  static_assert(kHeld >= kTileThreads, "no pair has more than a tile's pixels");

 public:
  int pairs, count;  // pairs from `first` on, and their fragments
  int64_t base;      // index of the first fragment

  // Called by all threads of the block. A barrier, `find_own` and another barrier must come before the next chunk,
  // whose warps write to `bits` immediately.
  __device__ Stretch(const Pairs& p, const TileThread& s, int64_t first, int64_t end, int (&bits)[kTileWarps][kWarp])
      : base(p.offsets[first]), bits_(bits) {
    const int64_t own = first + s.lane;  // one lane per pair
    const bool some = own < end;
    from_ = some ? int(p.offsets[own] - base) : 0;
    const int behind = some ? int(p.offsets[own + 1] - base) : kHeld + 1;
    mark_ = some ? p.masks[s.warp * p.pairs + own] : 0;
    pairs = __popc(__ballot_sync(kFullMask, behind <= kHeld));
    count = __shfl_sync(kFullMask, behind, pairs ? pairs - 1 : 0);
    if (s.lane >= pairs) mark_ = 0;
    bits[s.warp][s.lane] = __popc(mark_);
  }
  // Computes the offsets of the warp's fragments of each pair.
  __device__ void find_own(const TileThread& s) {
    BT_UNROLL
    for (int w = 0; w < kTileWarps - 1; ++w) from_ += w < s.warp ? bits_[w][s.lane] : 0;
  }
  // Then calls use(j, i, mine) for the pairs first + j with a fragment in the calling warp, front to back: fragment
  // base + i is that of the lane's pixel, if `mine`.
  template <class Use> __device__ void each_pair(const TileThread& s, Use&& use) const {
    for (unsigned todo = __ballot_sync(kFullMask, mark_ != 0); todo;) {
      const int j = take_first(todo);
      const unsigned taken = __shfl_sync(kFullMask, mark_, j);
      use(j, __shfl_sync(kFullMask, from_, j) + count_below(taken, s.lane), bool(taken >> s.lane & 1u));
    }
  }
  // Calls each(i, base + i) by all threads; a warp begins at a multiple of 32 of the list, to access whole sectors.
  template <class Each> __device__ void each_fragment(Each&& each) const {
    BT_UNROLL_BY(1)
    for (int i = int(threadIdx.x) - int(base % kWarp); i < count; i += kTileThreads)
      if (i >= 0) each(i, base + i);
  }

 private:
  int (&bits_)[kTileWarps][kWarp];  // fragments of a warp and a pair
  uint32_t mark_;                   // the warp's pixels that blend the lane's pair
  int from_;                        // start of the pair, then of the warp's fragments of it
};

// Computes the row of an image's pixel. Integer division takes 25 instructions; the product with the reciprocal is off
// by at most one, below 2^21 rows.
class RowOf {
 public:
  __device__ explicit RowOf(int width) : width_(width), inverse_(1.0f / float(width)) {}
  __device__ int32_t operator()(int32_t pixel) const {
    const int32_t row = int32_t(float(pixel) * inverse_), x = pixel - row * width_;
    return row + int32_t(x >= width_) - int32_t(x < 0);
  }

 private:
  int width_;
  float inverse_;
};

// Pairs of a tile's block. Pairs after those of all tiles (see BinFill) have slots and no fragments; the last block
// takes them.
struct PairRange {
  int64_t first, end;
};
__device__ inline PairRange block_pairs(const Pairs& p) {
  return {p.tile_pairs[blockIdx.x], blockIdx.x + 1 < gridDim.x ? p.tile_pairs[blockIdx.x + 1] : p.pairs};
}

// A tile's part of an image, in shared memory. Odd channel counts avoid bank conflicts.
class TilePart {
 public:
  __device__ explicit TilePart(const Pairs& p)
      : width_(p.width),
        left_(int(blockIdx.x) % tiles_across(p.width) * kTile),
        top_(int(blockIdx.x) / tiles_across(p.width) * kTile),
        columns_(min_(kTile, p.width - left_)),
        rows_(min_(kTile, p.height - top_)),
        row_of_(p.width) {}
  // Loads by all threads of the block; a barrier must follow.
  template <int kChannels, class S> __device__ void load(const S* image, S* to) const {
    for (int j = int(threadIdx.x); j < kTileThreads * kChannels; j += kTileThreads) {
      const int row = j / (kTile * kChannels), column = j - row * (kTile * kChannels);
      if (row < rows_ && column < columns_ * kChannels)
        to[j] = image[(int64_t(top_ + row) * width_ + left_) * kChannels + column];
    }
  }
  // Returns a pixel's index in the part, from its index in the image.
  __device__ int at(int32_t pixel) const {
    const int row = row_of_(pixel);
    return (row - top_) * kTile + (pixel - row * width_ - left_);
  }

 private:
  int width_, left_, top_, columns_, rows_;
  RowOf row_of_;
};

// Traversal by pair: kRunLanes lanes per pair take the fragments of its run in turn. A pair has about thirty fragments
// on average: 16 lanes are better utilised than 32, and share a row of geom and one sum.
constexpr int kRunLanes = 16, kRunThreads = 128;
struct Run {
  bool some;  // false after the last pair: the lane is idle but takes part in warp operations
  int lane;   // of kRunLanes
  int64_t k, begin, end;
};
__device__ inline Run run(const Pairs& p) {
  Run r;
  r.lane = int(threadIdx.x) % kRunLanes;
  r.k = int64_t(blockIdx.x) * (kRunThreads / kRunLanes) + threadIdx.x / kRunLanes;
  r.some = r.k < p.pairs;
  r.begin = r.some ? p.offsets[r.k] : 0, r.end = r.some ? p.offsets[r.k + 1] : 0;
  return r;
}
inline dim3 run_blocks(const Pairs& p) { return dim3(unsigned(ceil_div(p.pairs, kRunThreads / kRunLanes))); }

// Sums kColumns values over the lanes of a run: lane c % kColumns gets column c. Each step halves both the lanes that
// differ and the columns a lane keeps: 15 shuffles for 16 columns instead of 64. Recursive, as nvcc does not unroll a
// loop whose bounds halve, and would index registers.
template <int kStep, class S, int kColumns> __device__ __forceinline__ void fold_columns(S (&v)[kColumns], int lane) {
  const bool upper = lane & kStep;
  BT_UNROLL
  for (int c = 0; c < kStep; ++c) {
    const S mine = upper ? v[c + kStep] : v[c], other = upper ? v[c] : v[c + kStep];
    v[c] = mine + __shfl_xor_sync(kFullMask, other, kStep);
  }
  if constexpr (kStep > 1) fold_columns<kStep / 2>(v, lane);
}
template <int kColumns, class S> __device__ __forceinline__ S sum_over_run(S (&v)[kColumns], int lane) {
  static_assert((kColumns & (kColumns - 1)) == 0 && kColumns <= kRunLanes);
  BT_UNROLL
  for (int step = kRunLanes / 2; step >= kColumns; step /= 2) {
    BT_UNROLL
    for (int c = 0; c < kColumns; ++c) v[c] += __shfl_xor_sync(kFullMask, v[c], step);
  }
  if constexpr (kColumns > 1) fold_columns<kColumns / 2>(v, lane);
  return v[0];
}

// Calls put(surfel, column, sum) for every surfel and column of partial [pairs, kColumns], summed by slot. One warp per
// surfel: lanes are columns, groups of lanes take slots in turn. Surfels with more than kLong slots, such as a disc in
// front of the camera, are summed by the whole block, or their warps would finish last.
constexpr int kSlotThreads = 256, kSlotWarps = kSlotThreads / kWarp, kLong = 64;
template <int kColumns, class S>
__device__ inline S sum_slots_of(const S* partial, int64_t begin, int64_t end, int worker, int workers) {
  constexpr int kGroups = kWarp / kColumns;
  const int lane = int(threadIdx.x) % kWarp;
  S sum = S(0);
  for (int64_t i = begin + worker * kGroups + lane / kColumns; i < end; i += workers * kGroups)
    sum += partial[i * kColumns + lane % kColumns];
  BT_UNROLL
  for (int step = kWarp / 2; step >= kColumns; step /= 2) sum += __shfl_xor_sync(kFullMask, sum, step);
  return sum;
}
template <int kColumns, class S, class Put>
__global__ void __launch_bounds__(kSlotThreads) sum_slots_kernel(Pairs p, const S* partial, Put put) {
  __shared__ S shares[kSlotWarps][kColumns];
  const int warp = int(threadIdx.x) / kWarp, lane = int(threadIdx.x) % kWarp;
  const int64_t first = int64_t(blockIdx.x) * kSlotWarps, own = first + warp;
  if (own < p.surfels) {
    const int64_t begin = p.slot_start[own], end = p.slot_start[own + 1];
    if (end - begin <= kLong) {
      const S sum = sum_slots_of<kColumns>(partial, begin, end, 0, 1);
      if (lane < kColumns) put(p.order[own], lane, sum);
    }
  }
  for (int64_t r = first; r < first + kSlotWarps && r < p.surfels; ++r) {
    const int64_t begin = p.slot_start[r], end = p.slot_start[r + 1];
    if (end - begin <= kLong) continue;
    const S share = sum_slots_of<kColumns>(partial, begin, end, warp, kSlotWarps);
    if (lane < kColumns) shares[warp][lane] = share;
    __syncthreads();
    if (warp == 0 && lane < kColumns) {
      S sum = S(0);
      for (int w = 0; w < kSlotWarps; ++w) sum += shares[w][lane];
      put(p.order[r], lane, sum);
    }
    __syncthreads();  // before the next surfel's sums
  }
}
template <int kColumns, class S, class Put> void sum_slots(const Pairs& p, const S* partial, Put put, Stream stream) {
  static_assert((kColumns & (kColumns - 1)) == 0 && kColumns <= kWarp);
  if (!p.surfels) return;
  BT_LAUNCH((sum_slots_kernel<kColumns, S, Put>), dim3(unsigned(ceil_div(p.surfels, kSlotWarps))), dim3(kSlotThreads),
            0, stream, p, partial, put);
}

}  // namespace bt::cuda
