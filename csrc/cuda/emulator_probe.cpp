// Faulty kernels that the emulator must detect, so that tests prove its checks work.
#include "cuda/device.h"

namespace bt::emulator {

namespace {
constexpr int kThreads = 64, kWarp = 32;

__global__ void stale_kernel(int* found) {
  __shared__ int left[kThreads];
  found[blockIdx.x * kThreads + threadIdx.x] = left[threadIdx.x];  // unwritten
  left[threadIdx.x] = 7;
}
__global__ void barrier_kernel() {
  if (threadIdx.x % kWarp) __syncwarp();  // the first lane is missing, and waits elsewhere
  __syncthreads();
}
__global__ void aligned_kernel(const float* from, float* to) { to[0] = reinterpret_cast<const float4*>(from)->y; }
}  // namespace

int stale_numbers() {
  int found[3 * kThreads] = {}, sevens = 0;
  launch("stale_kernel", dim3(3), dim3(kThreads), 0, [&] { stale_kernel(found); });
  for (int number : found) sevens += number == 7;
  return sevens;
}
void open_barrier() {
  launch("barrier_kernel", dim3(1), dim3(kThreads), 0, [] { barrier_kernel(); });
}
float read_float4(int offset) {
  alignas(16) float from[8] = {0, 1, 2, 3, 4, 5, 6, 7};
  float to = 0;
  launch("aligned_kernel", dim3(1), dim3(1), 0, [&] { aligned_kernel(from + offset, &to); });
  return to;
}

}  // namespace bt::emulator
