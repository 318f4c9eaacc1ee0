// Number of threads, and how OpenMP's wait.
#include "cpu/threads.h"

#if __has_include(<pthread.h>)
#include <pthread.h>
#endif

#if defined(_OPENMP)
#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <future>
#include <system_error>
#include <thread>
#include <utility>
#endif

namespace bt {

namespace {
int g_threads = 0;
bool g_forked = false;
}  // namespace

int num_threads() {
#if defined(_OPENMP)
  if (!g_forked) return g_threads > 0 ? g_threads : omp_get_max_threads();
#endif
  return 1;
}
void set_num_threads(int n) { g_threads = n; }
void use_one_thread_after_fork() {
#if __has_include(<pthread.h>)
  pthread_atfork(nullptr, nullptr, [] { g_forked = true; });
#endif
}

// libgomp's threads spin for milliseconds after every parallel region, also torch's, unless OMP_WAIT_POLICY or
// GOMP_SPINCOUNT are set, which it reads when torch loads it: too late for a plugin. But according to its manual it
// spins a thousandth of that while a process has more OpenMP threads than processors: a second team of the missing
// threads, which sleeps for good, achieves this. A process with one thread, or that uses few processors, gets none.
void wait_without_spinning() {
#if defined(_OPENMP)
  const int processors = omp_get_num_procs(), threads = omp_get_max_threads();
  static bool done = false;
  if (done || processors < 2 || threads < 2 || 2 * threads < processors || std::getenv("OMP_WAIT_POLICY") ||
      std::getenv("GOMP_SPINCOUNT"))
    return;
  done = true;
  try {
    std::promise<void> promise;
    const std::future<void> started = promise.get_future();
    const int more = std::max(2, processors - threads + 2);
    std::thread([more, promise = std::move(promise)]() mutable {
#pragma omp parallel num_threads(more)
      std::this_thread::yield();
      promise.set_value();
      for (;;) std::this_thread::sleep_for(std::chrono::hours(24));  // a team lives as long as its first thread
    }).detach();
    started.wait();
  } catch (const std::system_error&) {  // no threads left: the others keep spinning, which is harmless
  }
#endif
}

}  // namespace bt
