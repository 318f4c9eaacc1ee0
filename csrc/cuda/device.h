// The language of kernels. nvcc compiles a source as CUDA; a C++ compiler makes the same source run on the host, thread
// by thread (emulator.h), so that indexing, barriers and warp operations are tested without a GPU.
#pragma once

#include <cstddef>
#include <cstdint>

#include "ops/arguments.h"

#if defined(__CUDACC__)

#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

namespace bt::cuda {

inline void check(cudaError_t error, const char* what) {
  if (error != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(error));
}

}  // namespace bt::cuda

// Launches kernel<<<grid, block, shared bytes, stream>>>(...). A kernel name with commas goes in parentheses.
#define BT_LAUNCH(kernel, grid, block, shared, stream, ...)                                \
  do {                                                                                     \
    kernel<<<(grid), (block), (shared), static_cast<cudaStream_t>(stream)>>>(__VA_ARGS__); \
    ::bt::cuda::check(cudaGetLastError(), #kernel);                                        \
  } while (0)

// As BT_UNROLL (core/common.h), n times.
#if defined(__CUDA_ARCH__)
#define BT_PRAGMA(text) _Pragma(#text)
#define BT_UNROLL_BY(n) BT_PRAGMA(unroll n)
#else
#define BT_UNROLL_BY(n)
#endif

// Requests more than 48 KB of shared memory per block.
#define BT_ALLOW_SHARED(kernel, bytes) \
  ::bt::cuda::check(                   \
      cudaFuncSetAttribute((kernel), cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes)), #kernel)

#define BT_DYNAMIC_SHARED(Type, name)                               \
  extern __shared__ __align__(16) unsigned char bt_shared_memory[]; \
  Type* name = reinterpret_cast<Type*>(bt_shared_memory)

#else

#include "cuda/emulator.h"

#define BT_ALLOW_SHARED(kernel, bytes) ((void)(kernel), (void)(bytes))

#define BT_LAUNCH(kernel, grid, block, shared, stream, ...) \
  ((void)(stream), ::bt::emulator::launch(#kernel, (grid), (block), (shared), [=] { kernel(__VA_ARGS__); }))

#define BT_UNROLL_BY(n)

#define BT_DYNAMIC_SHARED(Type, name) Type* name = static_cast<Type*>(::bt::emulator::dynamic_shared())

#endif

namespace bt::cuda {

// CUDA stream (cudaStream_t) without CUDA's headers; the emulator ignores it.
using Stream = void*;

constexpr int kWarp = 32;
constexpr unsigned kFullMask = 0xffffffffu;

// Threads per multiprocessor, an upper limit for launch bounds.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
constexpr int kMostThreads = 1024;
#else
constexpr int kMostThreads = 1536;
#endif
constexpr int bounded_blocks(int blocks, int threads) {
  return blocks * threads > kMostThreads ? kMostThreads / threads : blocks;
}

constexpr int64_t ceil_div(int64_t a, int64_t b) { return (a + b - 1) / b; }

// Launches a kernel with `threads` per block, one for each of n items; nothing without any.
#define BT_LAUNCH_EACH(kernel, n, threads, stream, ...)                                 \
  do {                                                                                  \
    if (const int64_t blocks = ::bt::cuda::ceil_div(n, threads); blocks > 0)            \
      BT_LAUNCH(kernel, dim3(unsigned(blocks)), dim3(threads), 0, stream, __VA_ARGS__); \
  } while (0)

// Zeroes memory of any number type.
template <class T> void fill_zero(T* to, int64_t count, Stream stream) {
  if (count <= 0) return;
#if defined(__CUDACC__)
  check(cudaMemsetAsync(to, 0, size_t(count) * sizeof(T), static_cast<cudaStream_t>(stream)), "clear memory");
#else
  (void)stream;
  for (int64_t i = 0; i < count; ++i) to[i] = T(0);
#endif
}

// Working memory, one block from which arrays are cut. With a null block it counts the bytes, else it returns
// addresses: one description serves both.
class Arena {
 public:
  explicit Arena(void* block) : base_(reinterpret_cast<uintptr_t>(block)) {}
  template <class T> T* take(int64_t count) {
    const uintptr_t at = base_ + uintptr_t(used_);
    used_ += (count * int64_t(sizeof(T)) + kAlign - 1) / kAlign * kAlign;
    return reinterpret_cast<T*>(at);
  }
  int64_t used() const { return used_; }

 private:
  static constexpr int64_t kAlign = 256;  // alignment of cudaMalloc
  uintptr_t base_;
  int64_t used_ = 0;
};
// Bytes of working memory described by Space, a class that an arena and these arguments make; and one cut from it.
template <class Space, class... A> int64_t space_bytes(const A&... a) {
  Arena arena(nullptr);
  Space(arena, a...);
  return arena.used();
}
template <class Space, class... A> Space cut_space(const Workspace& from, const A&... a) {
  Arena arena(from.of(space_bytes<Space>(a...)));
  return Space(arena, a...);
}

}  // namespace bt::cuda
