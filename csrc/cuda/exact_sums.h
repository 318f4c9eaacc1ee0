// Sums of gradients as integers, independent of the order of addition, in working memory of exact_size(entries)
// (ops/field.h): the entries, then their unit.
#pragma once

#include "core/field.h"
#include "cuda/warp.h"
#include "ops/field.h"

namespace bt::cuda {

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
