// Waiting of OpenMP's threads.
#include "cpu/threads.h"

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

// libgomp's threads spin for milliseconds after every parallel region, torch's regions and ours alike, unless
// OMP_WAIT_POLICY or GOMP_SPINCOUNT say otherwise. It reads these once, when torch loads it: too late for a plugin. But
// it spins a thousandth of that as long as a process has more OpenMP threads than processors, by its manual. A second
// team that sleeps for good brings that about, of as many threads as are missing. A process with one thread has none
// that spin, and one with few of the processors' threads leaves the other processors alone: there is no team for these.
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
      for (;;) std::this_thread::sleep_for(std::chrono::hours(24));  // a team lives as long as the thread that made it
    }).detach();
    started.wait();
  } catch (const std::system_error&) {  // no more threads to be had: the others spin, and nothing else is lost
  }
#endif
}

}  // namespace bt
