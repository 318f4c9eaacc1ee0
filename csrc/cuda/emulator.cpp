// Fibers in place of a block's threads. A fiber gets its stack by makecontext and is then switched by _setjmp and
// _longjmp, which, unlike swapcontext, make no system call: a switch takes tens of nanoseconds.
#undef _FORTIFY_SOURCE  // its longjmp rejects jumps to another stack
#include "cuda/emulator.h"

#include <link.h>
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

namespace bt::emulator {

Index thread_index, block_index;
dim3 grid_size;

namespace {
constexpr size_t kStack = 256 * 1024;
constexpr unsigned kLanesOfWarp = 32;

enum class State { kReady, kAtBlock, kAtWarp, kDone };

struct Fiber {
  ucontext_t context;  // start
  jmp_buf resume;      // where it was left
  bool begun = false;
  std::unique_ptr<char[]> stack{new char[kStack]};  // pages are allocated as used
  State state;
  Index index;
  unsigned mask;                    // of the warp operation it waits at
  uint64_t posted;                  // its value
  uint64_t received[kLanesOfWarp];  // values of the warp
};

std::vector<std::unique_ptr<Fiber>> fibers;
std::vector<uint64_t> shared_memory;
std::mt19937 shuffle;
jmp_buf scheduler;
size_t current;
const std::function<void()>* body;
bool inside = false;  // inside a kernel's thread
std::string fault;    // of a thread that was stopped

// _setjmp returns again when this side is resumed: no variable of the caller may be live across it.
__attribute__((noinline)) void enter(Fiber& f) {
  if (_setjmp(scheduler)) return;
  inside = true;
  if (f.begun) _longjmp(f.resume, 1);
  f.begun = true;
  setcontext(&f.context);
}
__attribute__((noinline)) void leave(Fiber& f, State state) {
  f.state = state;
  inside = false;
  if (!_setjmp(f.resume)) _longjmp(scheduler, 1);
}

void run_threads() {  // for block after block
  for (;;) {
    (*body)();
    leave(*fibers[current], State::kDone);
  }
}
__attribute__((noinline)) void make(Fiber& f) {
  getcontext(&f.context);
  f.context.uc_stack.ss_sp = f.stack.get();
  f.context.uc_stack.ss_size = kStack;
  f.context.uc_link = nullptr;
  makecontext(&f.context, run_threads, 0);
}

// Shared memory of all kernels: this library's thread-local storage, used for nothing else.
struct Range {
  char* begin = nullptr;
  size_t bytes = 0;
};
thread_local int mine = 0;  // ensures that the storage exists
int visit(dl_phdr_info* library, size_t, void* found) {
  const auto* at = reinterpret_cast<const char*>(&mine);
  for (int i = 0; i < library->dlpi_phnum; ++i) {
    const auto& segment = library->dlpi_phdr[i];
    auto* begin = static_cast<char*>(library->dlpi_tls_data);
    if (segment.p_type != PT_TLS || !begin || at < begin || at >= begin + segment.p_memsz) continue;
    *static_cast<Range*>(found) = {begin, segment.p_memsz};
    return 1;
  }
  return 0;
}
Range shared_of_kernels() {
  Range found;
  ++mine;
  dl_iterate_phdr(visit, &found);
  if (!found.begin) throw std::runtime_error("the emulator cannot find the shared memory of kernels");
  return found;
}

void wait(State at) { leave(*fibers[current], at); }

// Opens the barriers that all threads have reached; returns false if there are none.
bool open_barriers(size_t threads) {
  bool opened = false;
  size_t at_block = 0, done = 0;
  for (size_t i = 0; i < threads; ++i) {
    at_block += fibers[i]->state == State::kAtBlock;
    done += fibers[i]->state == State::kDone;
  }
  if (at_block && at_block + done == threads) {
    for (size_t i = 0; i < threads; ++i)
      if (fibers[i]->state == State::kAtBlock) fibers[i]->state = State::kReady;
    return true;
  }
  for (size_t warp = 0; warp < threads; warp += kLanesOfWarp) {
    const size_t lanes = std::min<size_t>(kLanesOfWarp, threads - warp);
    for (size_t i = 0; i < lanes; ++i) {
      if (fibers[warp + i]->state != State::kAtWarp) continue;
      const unsigned mask = fibers[warp + i]->mask;
      bool complete = mask >> i & 1u;
      for (size_t j = 0; j < lanes; ++j)
        if (mask >> j & 1u) {
          const Fiber& f = *fibers[warp + j];
          complete &= f.state == State::kDone || (f.state == State::kAtWarp && f.mask == mask);
        }
      if (!complete) continue;
      uint64_t values[kLanesOfWarp] = {};
      for (size_t j = 0; j < lanes; ++j)
        if ((mask >> j & 1u) && fibers[warp + j]->state == State::kAtWarp) values[j] = fibers[warp + j]->posted;
      for (size_t j = 0; j < lanes; ++j)
        if ((mask >> j & 1u) && fibers[warp + j]->state == State::kAtWarp) {
          std::copy_n(values, kLanesOfWarp, fibers[warp + j]->received);
          fibers[warp + j]->state = State::kReady;
        }
      opened = true;
    }
  }
  return opened;
}

[[noreturn]] void give_up(const std::string& why) {
  fibers.clear();  // they would resume in the middle of this kernel
  fault.clear();
  throw std::runtime_error(why);
}
}  // namespace

void misaligned(const char* file, unsigned line) {
  const std::string what = std::string(file) + ", line " + std::to_string(line) + ": a misaligned access";
  if (!inside) throw std::runtime_error(what);
  fault = what;
  leave(*fibers[current], State::kDone);
}

void set_seed(unsigned seed) { shuffle.seed(seed); }
void* dynamic_shared() { return shared_memory.data(); }
int lane() { return int(current % kLanesOfWarp); }

void block_barrier() { wait(State::kAtBlock); }
const uint64_t* warp_exchange(unsigned mask, uint64_t value) {
  Fiber& me = *fibers[current];
  me.mask = mask, me.posted = value;
  wait(State::kAtWarp);
  return me.received;
}

void launch(const char* kernel, dim3 grid, dim3 block, size_t shared, const std::function<void()>& thread) {
  const size_t threads = size_t(block.x) * block.y * block.z;
  if (!threads || threads > 1024 || !grid.x || !grid.y || !grid.z || grid.y > 65535 || grid.z > 65535)
    throw std::runtime_error(std::string(kernel) + ": invalid configuration of grid or block");
  if (shared > 227 * 1024) throw std::runtime_error(std::string(kernel) + ": more shared memory than a block has");
  while (fibers.size() < threads) {
    fibers.push_back(std::make_unique<Fiber>());
    make(*fibers.back());
  }
  grid_size = grid;
  body = &thread;
  std::vector<size_t> order(threads);
  for (size_t i = 0; i < threads; ++i) order[i] = i;
  std::vector<size_t> blocks(size_t(grid.x) * grid.y * grid.z);
  for (size_t i = 0; i < blocks.size(); ++i) blocks[i] = i;
  std::shuffle(blocks.begin(), blocks.end(), shuffle);
  const Range kept = shared_of_kernels();
  for (size_t b : blocks) {
    block_index = {unsigned(b % grid.x), unsigned(b / grid.x % grid.y), unsigned(b / grid.x / grid.y)};
    std::memset(kept.begin, 0xff, kept.bytes);  // NaN: reveals reads of unwritten memory
    shared_memory.assign(shared / 8 + 1, 0xffffffffffffffffull);
    for (size_t i = 0; i < threads; ++i) {
      fibers[i]->state = State::kReady;
      fibers[i]->index = {unsigned(i % block.x), unsigned(i / block.x % block.y), unsigned(i / block.x / block.y)};
    }
    for (;;) {
      std::shuffle(order.begin(), order.end(), shuffle);
      for (size_t i : order) {
        if (fibers[i]->state != State::kReady) continue;
        current = i;
        thread_index = fibers[i]->index;
        enter(*fibers[i]);
        if (!fault.empty()) give_up(std::string(kernel) + ": " + fault);
      }
      const bool finished =
          std::all_of(fibers.begin(), fibers.begin() + threads, [](const auto& f) { return f->state == State::kDone; });
      if (finished) break;
      const bool ready = std::any_of(fibers.begin(), fibers.begin() + threads,
                                     [](const auto& f) { return f->state == State::kReady; });
      if (!open_barriers(threads) && !ready)
        give_up(std::string(kernel) + ": threads wait at barriers that not all of them reach");
    }
  }
}

}  // namespace bt::emulator

// Called by code compiled with -fsanitize=alignment before an access that a GPU would refuse.
struct Access {
  const char* file;
  unsigned line, column;
};
extern "C" void __ubsan_handle_type_mismatch_v1(const Access* access, uintptr_t) {
  bt::emulator::misaligned(access->file, access->line);
}
