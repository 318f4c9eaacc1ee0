// Whole surfels of a fragment list, one after the other: the order of backward passes that add to what a surfel owns.
#pragma once

#include <cstdint>
#include <numeric>
#include <vector>

#include "core/texel.h"
#include "cpu/threads.h"

namespace bt {

// Runs are fragments of one surfel that follow each other in the list. `runs` has their surfels and lengths:
// runs.count(), runs.surfel(r), runs.length(r).

// The runs surfel by surfel, these in the order in which the list first has them, n at most. So they are neighbours on
// the screen that follow each other, whose runs lie near each other in the list, as their pixels do in the picture.
template <class R> std::vector<int64_t> by_surfel(const R& runs, int64_t n) {
  std::vector<int32_t> rank(n, -1);
  std::vector<int64_t> next{0};  // first the number of runs of each rank, then the offset of its next one
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

// fn(k, last) for the runs order[k] to order[last - 1] of every surfel. A thread takes whole surfels: what is added to
// their tiles is added by it alone, and in the order of the list.
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
