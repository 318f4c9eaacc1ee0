// The part of CUDA that the kernels use, on the host: each CUDA thread is a fiber; a block's threads run in shuffled
// order and switch at barriers and warp operations. A missing barrier shows as a wrong result for some seed, a barrier
// that not all threads reach as an error. Blocks run one after another in shuffled order, each with shared memory set
// to NaN (or, as indices, far out of range). For tests: correct, not fast.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>

struct dim3 {
  unsigned x, y, z;
  constexpr dim3(unsigned x_ = 1, unsigned y_ = 1, unsigned z_ = 1) : x(x_), y(y_), z(z_) {}
};
struct alignas(16) float4 {
  float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

namespace bt::emulator {

struct Index {
  unsigned x, y, z;
};
extern Index thread_index, block_index;
extern dim3 grid_size;

// Runs every thread of every block, in an order seeded by set_seed. Throws std::runtime_error when threads wait at
// barriers that can never open.
void launch(const char* kernel, dim3 grid, dim3 block, size_t shared, const std::function<void()>& thread);
void set_seed(unsigned seed);

// Faulty kernels that the emulator must detect (emulator_probe.cpp).
int stale_numbers();            // counts threads that read what an earlier block left in shared memory
void open_barrier();            // threads wait for one that never comes
float read_float4(int offset);  // reads the second of four floats, `offset` floats after a multiple of 16 bytes

void* dynamic_shared();  // of the running block

void block_barrier();
// Posts a value to the calling warp and returns those of all 32 lanes (0 for lanes outside the mask).
const uint64_t* warp_exchange(unsigned mask, uint64_t value);
int lane();
void misaligned(const char* file, unsigned line);  // ends the thread and fails the kernel

template <class T> uint64_t to_bits(T value) {
  static_assert(sizeof(T) <= 8);
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  return bits;
}
template <class T> T from_bits(uint64_t bits) {
  T value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

}  // namespace bt::emulator

#define __global__
#define __device__
#define __forceinline__ inline
#define __shared__ static thread_local  // found by `launch` in the thread's storage
#define __launch_bounds__(...)
#define __restrict__

#define threadIdx (::bt::emulator::thread_index)
#define blockIdx (::bt::emulator::block_index)
#define gridDim (::bt::emulator::grid_size)

inline void __syncthreads() { bt::emulator::block_barrier(); }
inline void __syncwarp(unsigned mask = 0xffffffffu) { bt::emulator::warp_exchange(mask, 0); }
inline unsigned __ballot_sync(unsigned mask, bool predicate) {
  const uint64_t* votes = bt::emulator::warp_exchange(mask, predicate);
  unsigned result = 0;
  for (int i = 0; i < 32; ++i) result |= unsigned(votes[i] != 0) << i;
  return result & mask;
}
inline bool __any_sync(unsigned mask, bool predicate) { return __ballot_sync(mask, predicate) != 0; }
template <class T> T __shfl_sync(unsigned mask, T value, int source) {
  const uint64_t* values = bt::emulator::warp_exchange(mask, bt::emulator::to_bits(value));
  return bt::emulator::from_bits<T>(values[source & 31]);
}
template <class T> T __shfl_xor_sync(unsigned mask, T value, int with) {
  const int lane = bt::emulator::lane();
  const uint64_t* values = bt::emulator::warp_exchange(mask, bt::emulator::to_bits(value));
  return bt::emulator::from_bits<T>(values[(lane ^ with) & 31]);
}
template <class T> T __shfl_up_sync(unsigned mask, T value, unsigned by) {
  const unsigned lane = unsigned(bt::emulator::lane());
  const uint64_t* values = bt::emulator::warp_exchange(mask, bt::emulator::to_bits(value));
  return lane >= by ? bt::emulator::from_bits<T>(values[lane - by]) : value;
}
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline long long __double2ll_rn(double x) { return std::fabs(x) < 9e18 ? std::llrint(x) : 0; }
inline int __clz(int x) { return x ? __builtin_clz(unsigned(x)) : 32; }
template <class T> T __ldg(const T* p) { return *p; }

// blocks and threads run one at a time, so read-modify-write is atomic
template <class T> T atomicAdd(T* to, T value) {
  const T old = *to;
  *to = old + value;
  return old;
}
template <class T> T atomicExch(T* to, T value) {
  const T old = *to;
  *to = value;
  return old;
}
template <class T> T atomicMax(T* to, T value) {
  const T old = *to;
  if (value > old) *to = value;
  return old;
}
