// Units of exact sums, and their conversion.
#include <cmath>

#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 256;

// Finds the largest |value| as the bits of a double, which are ordered like the numbers, with NaN above all.
template <class S>
__global__ void __launch_bounds__(kThreads) largest_kernel(int64_t n, const S* values, unsigned long long* bits) {
  unsigned long long most = 0;
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < n; i += int64_t(gridDim.x) * kThreads) {
    const double a = fabs(double(values[i]));
    unsigned long long b;
    memcpy(&b, &a, sizeof b);
    most = b > most ? b : most;
  }
  for (int offset = kWarp / 2; offset; offset /= 2) {
    const unsigned long long other = __shfl_xor_sync(kFullMask, most, offset);
    most = other > most ? other : most;
  }
  if (threadIdx.x % kWarp == 0 && most) atomicMax(bits, most);
}

// Returns 1 / unit for sums of `count` numbers of size up to `most`; NaN if not finite.
__device__ double scale_for(double most, int64_t count) {
  const double total = most * double(count > 0 ? count : 1);
  if (!finite_(total)) return NAN;
  if (!(total > 0)) return 1.0;
  int exponent;
  frexp(total, &exponent);
  return ldexp(1.0, exponent < -900 ? 961 : 61 - exponent);
}

// Bounds the gradients of the table's entries by the largest gradient of the field's output, times the weights of the
// decoder; without levels, the largest gradient itself is the bound.
template <class S> __global__ void range_kernel(FieldArrays<S> f, int64_t count, ExactRange* range) {
  double most;
  memcpy(&most, &range->gradient, sizeof most);
  double g2[kWidth] = {}, g1[kWidth] = {}, feature = f.levels ? 0 : most;
  for (int i = 0; f.levels && i < kWidth; ++i)
    for (int c = 0; c < 3; ++c) g2[i] += fabs(double(f.w3[3 * i + c])) * most;
  for (int i = 0; f.levels && i < kWidth; ++i)
    for (int o = 0; o < kWidth; ++o) g1[i] += fabs(double(f.w2[kWidth * i + o])) * g2[o];
  for (int j = 0; j < f.levels * kFeatures; ++j) {
    double d = 0;
    for (int o = 0; o < kWidth; ++o) d += fabs(double(f.w1[j * kWidth + o])) * g1[o];
    feature = max_(feature, d);
  }
  range->scale = scale_for(feature, count);
}

template <class S>
__global__ void __launch_bounds__(kThreads)
    convert_kernel(int64_t n, const unsigned long long* from, const double* scale, S* to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) to[i] = exact_value<S>(from[i], *scale);
}
}  // namespace

template <class S>
ExactSums begin_exact(int64_t* memory, int64_t entries, const FieldArrays<S>* field, int64_t count, int64_t numbers,
                      const S* gradients, Stream stream) {
  ExactSums e;
  e.sums = reinterpret_cast<unsigned long long*>(memory);
  e.range = reinterpret_cast<ExactRange*>(e.sums + entries);
  fill_zero(memory, exact_size(entries), stream);
  const int64_t blocks = min_<int64_t>(ceil_div(numbers, 4 * kThreads), kMostBlocks);
  if (numbers)
    BT_LAUNCH(largest_kernel<S>, dim3(unsigned(blocks)), dim3(kThreads), 0, stream, numbers, gradients,
              &e.range->gradient);
  const FieldArrays<S> f = field ? *field : FieldArrays<S>{};
  BT_LAUNCH(range_kernel<S>, dim3(1), dim3(1), 0, stream, f, count, e.range);
  return e;
}

template <class S> void end_exact(const ExactSums& exact, int64_t entries, S* to, Stream stream) {
  BT_LAUNCH_EACH(convert_kernel<S>, entries, kThreads, stream, entries, exact.sums, &exact.range->scale, to);
}

template ExactSums begin_exact<float>(int64_t*, int64_t, const FieldArrays<float>*, int64_t, int64_t, const float*,
                                      Stream);
template ExactSums begin_exact<double>(int64_t*, int64_t, const FieldArrays<double>*, int64_t, int64_t, const double*,
                                       Stream);
template void end_exact<float>(const ExactSums&, int64_t, float*, Stream);
template void end_exact<double>(const ExactSums&, int64_t, double*, Stream);

}  // namespace bt::cuda
