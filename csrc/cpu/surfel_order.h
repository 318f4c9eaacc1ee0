// Grouping of a fragment list by surfel, for backward passes that add to per-surfel data.
#pragma once

#include <cstdint>
#include <numeric>
#include <vector>

#include "core/texel.h"
#include "cpu/threads.h"

namespace bt {

// Runs are consecutive fragments of one surfel in the list: runs.count(), runs.surfel(r), runs.length(r).

// Returns the runs grouped by surfel, surfels (at most n) in order of first appearance. Consecutive surfels are then
// neighbours on the screen, so their runs lie close together in the list, as do their pixels.
template <class R> std::vector<int64_t> by_surfel(const R& runs, int64_t n) {
  std::vector<int32_t> rank(n, -1);
  std::vector<int64_t> next{0};  // number of runs of each rank, then the offset of its next one
  for (int64_t r = 0; r < runs.count(); ++r) {
    int32_t& its = rank[runs.surfel(r)];
    if (its < 0) its = int32_t(next.size()) - 1, next.push_back(0);
    ++next[its + 1];
  }
  std::partial_sum(next.begin(), next.end(), next.begin());
  std::vector<int64_t> order(runs.count());
  for (int64_t r = 0; r < runs.count(); ++r) order[next[rank[runs.surfel(r)]]++] = r;
  return order;
}

// Calls fn(k, last) for the runs order[k] to order[last - 1] of every surfel. One thread handles all runs of a surfel
// in list order, so no other thread adds to its texels.
template <class R, class F> void for_surfels(const R& runs, const int64_t* order, F&& fn) {
  const int64_t count = runs.count();
  std::vector<int64_t> cost(count + 1, 0);
  for (int64_t k = 0; k < count; ++k) cost[k + 1] = cost[k] + runs.length(order[k]);
  const auto id = [&](int64_t k) { return runs.surfel(order[k]); };
  parallel_tiles(cost.data(), count, 1 << 20, [&](int, int64_t begin, int64_t end) {
    while (begin > 0 && begin < count && id(begin) == id(begin - 1)) ++begin;
    while (end < count && id(end) == id(end - 1)) ++end;
    for (int64_t k = begin, last; k < end; k = last) {
      for (last = k + 1; last < end && id(last) == id(k);) ++last;
      fn(k, last);
    }
  });
}

}  // namespace bt
