// Sums of gradients as integers, which come out the same in whatever order they are added. In working memory of
// exact_size(entries) (ops/field.h): the entries, then their unit.
#pragma once

#include "core/field.h"
#include "cuda/warp.h"
#include "ops/field.h"

namespace bt::cuda {

// Bits of the largest |gradient| as a double, and 1 / unit of the sums.
struct ExactRange {
  unsigned long long gradient;
  double scale;
};
static_assert(sizeof(ExactRange) == kExactRange * sizeof(int64_t));
// Null when sums need not be exact.
struct ExactSums {
  unsigned long long* sums = nullptr;
  ExactRange* range = nullptr;
};
// Adds to exact sums, or to the numbers of `sums`.
template <bool kExact, class S> __device__ Adder<S, kExact> adder(S* sums, const ExactSums& exact) {
  if constexpr (kExact)
    return {exact.sums, exact.range->scale};
  else
    return {sums};
}

// Clears the exact sums and finds their unit, such that no sum of `count` gradients can overflow, none of them larger
// than the largest of `numbers`. The entries are those of the field's table; without a field, sums of shares of the
// gradients, of at most 1 each in all.
template <class S>
ExactSums begin_exact(int64_t* memory, int64_t entries, const FieldArrays<S>* field, int64_t count, int64_t numbers,
                      const S* gradients, Stream stream);
// Writes the exact sums as numbers to [entries].
template <class S> void end_exact(const ExactSums& exact, int64_t entries, S* to, Stream stream);

}  // namespace bt::cuda
