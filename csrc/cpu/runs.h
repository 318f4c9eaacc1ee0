// Whole surfels of a fragment list, one after the other: the order of backward passes that add to what a surfel owns.
#pragma once

#include <cstdint>
#include <numeric>
#include <vector>

#include "core/texel.h"
#include "cpu/threads.h"

namespace bt {

// Fragments of one surfel that follow each other, from `start[r]` to `start[r + 1]`; `order` sorts the runs by surfel.
struct Runs {
  const int32_t* surfel;  // of every fragment
  const int64_t *start, *order;
  int64_t count;

  int64_t id(int64_t k) const { return surfel[start[order[k]]]; }
};

// fn(k, last) for the runs order[k] to order[last - 1] of every surfel. A thread takes whole surfels: what is added to
// their tiles is added by it alone, and in the order of the list.
template <class F>
void for_surfels(const Runs& runs, F&& fn) {
  std::vector<int64_t> cost(runs.count + 1, 0);
  for (int64_t r = 0; r < runs.count; ++r)
    cost[r + 1] = cost[r] + runs.start[runs.order[r] + 1] - runs.start[runs.order[r]];
  parallel_tiles(cost.data(), runs.count, 1 << 20, [&](int, int64_t begin, int64_t end) {
    while (begin > 0 && begin < runs.count && runs.id(begin) == runs.id(begin - 1)) ++begin;
    while (end < runs.count && runs.id(end) == runs.id(end - 1)) ++end;
    for (int64_t k = begin, last; k < end; k = last) {
      for (last = k + 1; last < end && runs.id(last) == runs.id(k);) ++last;
      fn(k, last);
    }
  });
}

// The runs of a fragment list of n surfels, these in the order in which the list first has them. So they are neighbours
// on the screen that follow each other, whose runs lie near each other in the list, as their pixels do in the picture.
struct FoundRuns {
  std::vector<int64_t> start, order;

  FoundRuns(const int32_t* surfel, int64_t fragments, int64_t n) : start{0} {
    std::vector<int32_t> rank(n, -1);
    std::vector<int64_t> next{0};  // first the number of runs of each rank, then the place of its next one
    for (int64_t i = 0; i < fragments; ++i) {
      if (i + 1 < fragments && surfel[i + 1] == surfel[i]) continue;
      start.push_back(i + 1);
      int32_t& r = rank[surfel[i]];
      if (r < 0) r = int32_t(next.size()) - 1, next.push_back(0);
      ++next[r + 1];
    }
    std::partial_sum(next.begin(), next.end(), next.begin());
    order.resize(start.size() - 1);
    for (size_t r = 0; r < order.size(); ++r) order[next[rank[surfel[start[r]]]]++] = int64_t(r);
  }
};

// Moves `count` texels by their shares and gradients, which lie `row` numbers apart.
template <class S>
void move_texels(S* texels, const S* gradients, int row, S rate, const S* share, int64_t count) {
  for (int64_t t = 0; t < count; ++t, texels += 3, gradients += row)
    store3(texels, texel_step(load3(texels), load3(gradients), rate, share[t]));
}

}  // namespace bt
