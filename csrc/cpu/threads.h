// Threads: OpenMP where there is one.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace bt {

int num_threads();

// From now on idle threads sleep instead of spinning, unless OMP_WAIT_POLICY or GOMP_SPINCOUNT decide; once a process.
void wait_without_spinning();

// fn(thread, begin, end) over n items in equal, fixed parts.
template <class F>
void parallel_parts(int64_t n, int64_t least, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(num_threads(), n / std::max<int64_t>(least, 1))));
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) fn(t, n * t / parts, n * (t + 1) / parts);
}

// Boundaries that cut items of given running cost (start[i+1] - start[i]) into `parts` of about equal cost. They depend
// on the input alone, so that sums over the parts come out the same however the threads are scheduled.
inline std::vector<int64_t> balanced_parts(const int64_t* start, int64_t items, int parts) {
  std::vector<int64_t> cut(parts + 1, items);
  cut[0] = 0;
  for (int p = 1; p < parts; ++p) {
    const int64_t target = start[0] + (start[items] - start[0]) * p / parts;
    cut[p] = std::max(cut[p - 1], int64_t(std::lower_bound(start, start + items + 1, target) - start));
    cut[p] = std::min(cut[p], items);
  }
  return cut;
}

// fn(thread, begin, end) over tiles, balanced by their fragments.
template <class F>
int parallel_tiles(const int64_t* tile_start, int64_t tiles, int most, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(std::min(num_threads(), most), tiles)));
  const std::vector<int64_t> cut = balanced_parts(tile_start, tiles, parts);
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) fn(t, cut[t], cut[t + 1]);
  return parts;
}

}  // namespace bt
