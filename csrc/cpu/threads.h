// Threads: OpenMP if available.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <thread>
#include <vector>

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace bt {

int num_threads();

// Lets idle threads sleep instead of spin, unless OMP_WAIT_POLICY or GOMP_SPINCOUNT are set; once per process.
void wait_without_spinning();

// Calls fn(thread, begin, end) over n items in equal, fixed parts.
template <class F> void parallel_parts(int64_t n, int64_t least, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(num_threads(), n / std::max<int64_t>(least, 1))));
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) fn(t, n * t / parts, n * (t + 1) / parts);
}

// Splits items of cumulative cost `start` into `parts` of about equal cost, depending on the input alone, so that sums
// over the parts do not depend on scheduling.
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

// Calls fn(thread, begin, end) over tiles, balanced by fragments.
template <class F> int parallel_tiles(const int64_t* tile_start, int64_t tiles, int most, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(std::min(num_threads(), most), tiles)));
  const std::vector<int64_t> cut = balanced_parts(tile_start, tiles, parts);
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) fn(t, cut[t], cut[t + 1]);
  return parts;
}

// Threads that run the phases of one task together. OpenMP's threads sleep between parallel regions (threads.cpp), and
// waking them takes 0.1 ms, as long as a small phase; a team waits awake.
class Team {
 public:
  // Waits for all `size` threads: spinning, then yielding, after some milliseconds asleep.
  void meet(int size) {
    const uint32_t turn = turn_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) == size - 1) {
      arrived_.store(0, std::memory_order_relaxed), taken_.store(0, std::memory_order_relaxed);
      turn_.fetch_add(1, std::memory_order_release);
      return;
    }
    for (int spins = 0; turn_.load(std::memory_order_acquire) == turn; ++spins)
      if (spins < kSpins)
        pause();
      else if (spins < 2 * kSpins)
        std::this_thread::yield();
      else
        std::this_thread::sleep_for(std::chrono::microseconds(20));
  }
  // Takes the next `count` items of the phase; returns the first.
  int64_t take(int64_t count) { return taken_.fetch_add(count, std::memory_order_relaxed); }

 private:
  static constexpr int kSpins = 2000;  // some tens of microseconds
  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#endif
  }
  std::atomic<uint32_t> turn_{0};  // number of meetings
  std::atomic<int> arrived_{0};
  std::atomic<int64_t> taken_{0};
};
// A thread of a team.
struct Member {
  Team& team;
  int index, size;

  // Ends a phase: writes of all threads become visible.
  void meet() const { team.meet(size); }
  // Calls fn(begin, end) over n items, `step` at a time, dynamically; once per phase.
  template <class F> void each(int64_t n, int64_t step, F&& fn) const {
    for (int64_t begin; (begin = team.take(step)) < n;) fn(begin, std::min(begin + step, n));
  }
};
// Runs fn(member) on every thread.
template <class F> void run_together(F&& fn) {
  Team team;
#if defined(_OPENMP)
#pragma omp parallel num_threads(num_threads())
  fn(Member{team, omp_get_thread_num(), omp_get_num_threads()});
#else
  fn(Member{team, 0, 1});
#endif
}

}  // namespace bt
