// Whole surfels of a fragment list, one after the other: the order of backward passes that add to what a surfel owns.
#pragma once

#include <cstdint>
#include <numeric>
#include <vector>

#include "core/texel.h"
#include "cpu/threads.h"

namespace bt {

// Runs are fragments of one surfel that follow each other in the list. `runs` says whose they are and how long:
// runs.count(), runs.surfel(r), runs.length(r).

// Runs from start[r] to start[r + 1] - 1.
struct FragmentRuns {
  const int32_t* of;  // the surfel of every fragment
  const int64_t* start;
  int64_t runs;

  int64_t count() const { return runs; }
  int32_t surfel(int64_t r) const { return of[start[r]]; }
  int64_t length(int64_t r) const { return start[r + 1] - start[r]; }
};
// Where fragments of another surfel begin, and the end of the list.
inline std::vector<int64_t> run_starts(const int32_t* surfel, int64_t fragments) {
  std::vector<int64_t> start{0};
  for (int64_t i = 1; i <= fragments; ++i)
    if (i == fragments || surfel[i] != surfel[i - 1]) start.push_back(i);
  return start;
}

// The runs surfel by surfel, these in the order in which the list first has them, n at most. So they are neighbours on
// the screen that follow each other, whose runs lie near each other in the list, as their pixels do in the picture.
template <class R>
std::vector<int64_t> by_surfel(const R& runs, int64_t n) {
  std::vector<int32_t> rank(n, -1);
  std::vector<int64_t> next{0};  // first the number of runs of each rank, then the place of its next one
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
template <class R, class F>
void for_surfels(const R& runs, const int64_t* order, F&& fn) {
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

// Moves `count` texels by their shares and gradients, which lie `row` numbers apart.
template <class S>
void move_texels(S* texels, const S* gradients, int row, S rate, const S* share, int64_t count) {
  for (int64_t t = 0; t < count; ++t, texels += 3, gradients += row)
    store3(texels, texel_step(load3(texels), load3(gradients), rate, share[t]));
}

}  // namespace bt
