// Threads, by OpenMP if available, and allocation of large blocks.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <exception>
#include <memory>
#include <new>
#include <thread>
#include <vector>

#if defined(_OPENMP)
#include <omp.h>
#endif
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace bt {

// Threads of the kernels: as set, else OpenMP's; one in a forked child, whose OpenMP would wait for threads
// of its parent.
int num_threads();
void set_num_threads(int n);
void use_one_thread_after_fork();  // registers the above

// Lets idle threads sleep instead of spin, unless OMP_WAIT_POLICY or GOMP_SPINCOUNT are set; once per process.
void wait_without_spinning();

// Calls fn(thread, size) on `size` threads at once, at most `most`. The first exception is thrown again behind the
// parallel region, which none may leave.
template <class F> void on_threads(int most, F&& fn) {
#if defined(_OPENMP)
  if (most > 1) {
    std::atomic<bool> failed{false};
    std::exception_ptr first;
#pragma omp parallel num_threads(most)
    {
      try {
        fn(omp_get_thread_num(), omp_get_num_threads());
      } catch (...) {
        if (!failed.exchange(true)) first = std::current_exception();
      }
    }
    if (first) std::rethrow_exception(first);
    return;
  }
#endif
  fn(0, 1);
}

// Calls fn(part, begin, end) over n items in equal, fixed parts.
template <class F> void parallel_parts(int64_t n, int64_t least, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(num_threads(), n / std::max<int64_t>(least, 1))));
  on_threads(parts, [&](int thread, int size) {
    for (int p = thread; p < parts; p += size) fn(p, n * p / parts, n * (p + 1) / parts);
  });
}

// Calls fn(i) for n items, by such parts.
template <class F> void parallel_each(int64_t n, int64_t least, F&& fn) {
  parallel_parts(n, least, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) fn(i);
  });
}

// Splits items of cumulative cost `start` into `parts` of about equal cost, by the input alone.
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

// Calls fn(part, begin, end) over tiles, balanced by fragments.
template <class F> int parallel_tiles(const int64_t* tile_start, int64_t tiles, int most, F&& fn) {
  const int parts = int(std::max<int64_t>(1, std::min<int64_t>(std::min(num_threads(), most), tiles)));
  const std::vector<int64_t> cut = balanced_parts(tile_start, tiles, parts);
  on_threads(parts, [&](int thread, int size) {
    for (int p = thread; p < parts; p += size) fn(p, cut[p], cut[p + 1]);
  });
  return parts;
}

// Threads that run the phases of one task together, and wait awake: waking OpenMP's (threads.cpp) takes 0.1 ms, as long
// as a small phase.
class Team {
 public:
  struct Released {};  // thrown by meet() once a thread has failed, which will not come

  // Waits for all `size` threads: spinning, then yielding, after some milliseconds asleep.
  void meet(int size) {
    const uint32_t turn = turn_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) == size - 1) {
      arrived_.store(0, std::memory_order_relaxed), taken_.store(0, std::memory_order_relaxed);
      turn_.fetch_add(1, std::memory_order_release);
      return;
    }
    uint32_t now;
    for (int spins = 0; (now = turn_.load(std::memory_order_acquire)) == turn && now < kReleased; ++spins)
      if (spins < kSpins)
        pause();
      else if (spins < 2 * kSpins)
        std::this_thread::yield();
      else
        std::this_thread::sleep_for(std::chrono::microseconds(20));
    if (now >= kReleased) throw Released();
  }
  // Ends all waiting, now and later.
  void release() { turn_.fetch_or(kReleased, std::memory_order_release); }
  // Takes the next `count` items of the phase; returns the first.
  int64_t take(int64_t count) { return taken_.fetch_add(count, std::memory_order_relaxed); }

 private:
  static constexpr int kSpins = 2000;  // some tens of microseconds
  static constexpr uint32_t kReleased = uint32_t(1) << 31;
  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#endif
  }
  std::atomic<uint32_t> turn_{0};  // number of meetings, and kReleased
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
template <class F> void run_together(F&& fn, int threads = num_threads()) {
  Team team;
  on_threads(threads, [&](int index, int size) {
    try {
      fn(Member{team, index, size});
    } catch (const Team::Released&) {  // the one that failed throws
    } catch (...) {
      team.release();
      throw;
    }
  });
}

struct FreeMemory {
  void operator()(unsigned char* p) const { std::free(p); }
};
using Memory = std::unique_ptr<unsigned char, FreeMemory>;

constexpr size_t kLargePage = size_t(1) << 21;

// Requests large pages for this range: first writes then take a sixth of the time.
inline void use_large_pages(void* at, size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  const uintptr_t from = (reinterpret_cast<uintptr_t>(at) + kLargePage - 1) / kLargePage * kLargePage;
  const uintptr_t to = (reinterpret_cast<uintptr_t>(at) + bytes) / kLargePage * kLargePage;
  if (from < to) madvise(reinterpret_cast<void*>(from), to - from, MADV_HUGEPAGE);
#else
  (void)at, (void)bytes;
#endif
}

// Allocates uncleared memory; unwritten pages cost nothing.
inline Memory allocate(size_t bytes, bool large_pages) {
  bytes = (bytes + kLargePage - 1) / kLargePage * kLargePage;
  Memory memory(static_cast<unsigned char*>(std::aligned_alloc(kLargePage, bytes)));
  if (!memory) throw std::bad_alloc();
  if (large_pages) use_large_pages(memory.get(), bytes);
  return memory;
}

}  // namespace bt
