// Warp operations: runs of lanes with equal keys, sums over them, additions to memory.
#pragma once

#include "core/common.h"
#include "cuda/device.h"
#include "ops/field.h"

namespace bt::cuda {

// Counts the lanes of `in` below this one.
__device__ inline int count_below(unsigned in, int lane) { return __popc(in & ((1u << lane) - 1u)); }
// Sums the values of the lanes below this one. All 32 lanes take part.
__device__ inline int sum_below(int value, int lane) {
  int sum = value;
  BT_UNROLL
  for (int step = 1; step < kWarp; step *= 2) {
    const int other = __shfl_up_sync(kFullMask, sum, step);
    if (lane >= step) sum += other;
  }
  return sum - value;
}
// Removes and returns the first or last lane of a non-empty mask.
__device__ inline int take_first(unsigned& lanes) {
  const int lane = __ffs(int(lanes)) - 1;
  lanes &= lanes - 1;
  return lane;
}
__device__ inline int take_last(unsigned& lanes) {
  const int lane = kWarp - 1 - __clz(int(lanes));
  lanes &= ~(1u << lane);
  return lane;
}

// Returns the lanes of this lane's run: neighbours with the same key. All 32 lanes take part.
template <class Key> __device__ unsigned run_of(Key key, int lane) {
  const Key before = __shfl_up_sync(kFullMask, key, 1);
  const unsigned heads = __ballot_sync(kFullMask, lane == 0 || key != before);
  const unsigned upto = heads & (0xffffffffu >> (kWarp - 1 - lane));  // has bit 0: lane 0 is a head
  const unsigned after = lane == kWarp - 1 ? 0u : heads & (0xfffffffeu << lane);
  const unsigned from_head = 0xffffffffu << (kWarp - 1 - __clz(int(upto)));
  const unsigned to_end = after ? (1u << (__ffs(int(after)) - 1)) - 1u : 0xffffffffu;
  return from_head & to_end;
}

// Sums M values over the lanes of each run, in fixed order; the run's first lane gets the sum. Takes log2(longest run)
// steps of M shuffles.
template <int M, class S> __device__ void sum_over_run(unsigned run, int lane, S (&value)[M]) {
  const int above = kWarp - 1 - __clz(int(run)) - lane;  // lanes of the run after this one
  for (int step = 1; __any_sync(kFullMask, above >= step); step *= 2) {
    BT_UNROLL
    for (int m = 0; m < M; ++m) {
      const S other = __shfl_sync(kFullMask, value[m], lane + step);
      if (above >= step) value[m] += other;  // the sum of that lane and the step - 1 after it
    }
  }
}

// Sums the values of a block of kThreads (a power of two) in fixed order; thread 0 gets the sum. `shared` has room for
// all values.
template <int kThreads> __device__ double block_sum(double own, double* shared) {
  const int thread = int(threadIdx.x);
  shared[thread] = own;
  for (int half = kThreads / 2; half; half /= 2) {
    __syncthreads();
    if (thread < half) shared[thread] += shared[thread + half];
  }
  return shared[thread];
}

// Converts an integer sum in units of 1 / scale to a number.
template <class S> __device__ S exact_value(unsigned long long sum, double scale) {
  return S(double(static_cast<long long>(sum)) / scale);
}

// Adds to memory shared by all blocks. Floating-point sums depend on the order of blocks; for reproducible results,
// values are added as integers in units of 1 / scale.
template <class S, bool kExact> struct Adder;
template <class S> struct Adder<S, false> {
  S* to;
  __device__ void add(int64_t at, S value) const { atomicAdd(to + at, value); }
  // four neighbours, `at` a multiple of 4
  __device__ void add4(int64_t at, const S* v) const {
    for (int j = 0; j < 4; ++j) atomicAdd(to + at + j, v[j]);
  }
  // Returns the sum, after all additions.
  __device__ S sum(int64_t at) const { return to[at]; }
};
template <> __device__ inline void Adder<float, false>::add4(int64_t at, const float* v) const {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900 && (__CUDACC_VER_MAJOR__ > 12 || __CUDACC_VER_MINOR__ >= 1)
  // one request of 16 bytes to L2 instead of four of 4
  asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(__cvta_generic_to_global(to + at)), "f"(v[0]),
               "f"(v[1]), "f"(v[2]), "f"(v[3])
               : "memory");
#else
  for (int j = 0; j < 4; ++j) atomicAdd(to + at + j, v[j]);
#endif
}
template <class S> struct Adder<S, true> {
  unsigned long long* to;  // two's complement
  double scale;
  __device__ void add(int64_t at, S value) const {
    atomicAdd(to + at, static_cast<unsigned long long>(__double2ll_rn(double(value) * scale)));
  }
  __device__ void add4(int64_t at, const S* v) const {
    for (int j = 0; j < 4; ++j) add(at + j, v[j]);
  }
  __device__ S sum(int64_t at) const { return exact_value<S>(to[at], scale); }
};

// Sums of gradients as integers, independent of the order of addition, in working memory of exact_size(entries)
// (ops/field.h): the entries, then their unit.

// Largest |gradient| as the bits of a double, and 1 / unit of the sums.
struct ExactRange {
  unsigned long long gradient;
  double scale;
};
static_assert(sizeof(ExactRange) == kExactRange * sizeof(int64_t));
// Null if sums need not be exact.
struct ExactSums {
  unsigned long long* sums = nullptr;
  ExactRange* range = nullptr;
};
// Returns what adds to the exact sums, or to the numbers of `sums`.
template <bool kExact, class S> __device__ Adder<S, kExact> adder(S* sums, const ExactSums& exact) {
  if constexpr (kExact)
    return {exact.sums, exact.range->scale};
  else
    return {sums};
}

// Clears the exact sums and chooses their unit so that no sum of `count` terms overflows. The largest of `gradients`
// [numbers] bounds a term: with a field, whose output they are for and whose table has the entries, through the
// decoder's weights; without, a term is a gradient times a weight of at most 1.
template <class S>
ExactSums begin_exact(int64_t* memory, int64_t entries, const FieldArrays<S>* field, int64_t count, int64_t numbers,
                      const S* gradients, Stream stream);
// Converts the exact sums to numbers [entries].
template <class S> void end_exact(const ExactSums& exact, int64_t entries, S* to, Stream stream);

}  // namespace bt::cuda
