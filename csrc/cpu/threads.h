// Threads: OpenMP where there is one.
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

// From now on idle threads sleep instead of spinning, unless OMP_WAIT_POLICY or GOMP_SPINCOUNT decide; once a process.
void wait_without_spinning();

// fn(thread, begin, end) over n items in equal, fixed parts.
template <class F> void parallel_parts(int64_t n, int64_t least, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(num_threads(), n / std::max<int64_t>(least, 1))));
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) fn(t, n * t / parts, n * (t + 1) / parts);
}

// Boundaries that cut items of running cost (start[i+1] - start[i]) into `parts` of about equal cost. They depend
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
template <class F> int parallel_tiles(const int64_t* tile_start, int64_t tiles, int most, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(std::min(num_threads(), most), tiles)));
  const std::vector<int64_t> cut = balanced_parts(tile_start, tiles, parts);
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) fn(t, cut[t], cut[t + 1]);
  return parts;
}

// Threads that go through the phases of one piece of work together. OpenMP's threads sleep between its regions
// (threads.cpp), and to wake them takes a tenth of a millisecond, as long as a small phase: in a team they wait awake.
class Team {
 public:
  // Waits until all `size` of them are here: awake, then giving its processor to others, after some milliseconds
  // asleep.
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
  // Takes the next `count` of the phase's items; returns the first.
  int64_t take(int64_t count) { return taken_.fetch_add(count, std::memory_order_relaxed); }

 private:
  static constexpr int kSpins = 2000;  // some tens of microseconds
  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#endif
  }
  std::atomic<uint32_t> turn_{0};  // how often all have met
  std::atomic<int> arrived_{0};
  std::atomic<int64_t> taken_{0};
};
// One thread of a team.
struct Member {
  Team& team;
  int index, size;

  // The end of a phase: what the others wrote in it is there.
  void meet() const { team.meet(size); }
  // fn(begin, end) over n items, `step` at a time, by whoever comes first. Once in a phase.
  template <class F> void each(int64_t n, int64_t step, F&& fn) const {
    for (int64_t begin; (begin = team.take(step)) < n;) fn(begin, std::min(begin + step, n));
  }
};
// fn(member) by every thread.
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
