// Sums that the backward passes of the field leave to be finished: the blocks' shares of the weights' gradients, and
// sums in integers, which come out the same in whatever order they are added.
#include <cmath>

#include "cuda/field_device.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 256;
constexpr int kRows = kThreads / kWarp;

// 32 columns per block: 8 groups of threads walk down the rows, then the groups are added in order.
template <class S>
__global__ void __launch_bounds__(kThreads)
    sum_weights_kernel(const S* partial, int blocks, int levels, FieldGradients<S> out) {
  __shared__ S sums[kRows][kWarp];
  const int column = int(blockIdx.x) * kWarp + int(threadIdx.x) % kWarp, group = int(threadIdx.x) / kWarp;
  S total = S(0);
  if (column < kMlpWeights)
    for (int b = group; b < blocks; b += kRows) total += partial[int64_t(b) * kMlpWeights + column];
  sums[group][threadIdx.x % kWarp] = total;
  __syncthreads();
  if (group || column >= kMlpWeights) return;
  for (int g = 1; g < kRows; ++g) total += sums[g][threadIdx.x];
  constexpr int kMatrix = kWidth * kWidth;
  if (column < levels * kFeatures * kWidth) out.w1[column] = total;
  if (column >= kMatrix && column < 2 * kMatrix) out.w2[column - kMatrix] = total;
  if (column >= 2 * kMatrix) out.w3[column - 2 * kMatrix] = total;
}

// The largest |value|, as the bits of a double: they are ordered like the numbers, and NaN is above all.
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
template <class S> void largest(int64_t n, const S* values, unsigned long long* bits, Stream stream) {
  if (!n) return;
  const int64_t blocks = ceil_div(n, 4 * kThreads);
  BT_LAUNCH(largest_kernel<S>, dim3(unsigned(blocks < kMostBlocks ? blocks : kMostBlocks)), dim3(kThreads), 0, stream,
            n, values, bits);
}

// 1 / unit for sums of `count` numbers of size up to `most`; NaN when they are not finite.
__device__ double scale_for(double most, int64_t count) {
  const double total = most * double(count > 0 ? count : 1);
  if (!finite_(total)) return NAN;
  if (!(total > 0)) return 1.0;
  int exponent;
  frexp(total, &exponent);
  return ldexp(1.0, exponent < -900 ? 961 : 61 - exponent);
}

// Bounds of all sums from the largest gradient and entry and the weights.
template <class S> __global__ void range_kernel(FieldArrays<S> f, int64_t count, ExactRange* range) {
  double most, entry;
  memcpy(&most, &range->gradient, sizeof most);
  memcpy(&entry, &range->entry, sizeof entry);
  range->base = scale_for(most, count);
  double g2[kWidth], g1[kWidth], steepest = 0, feature = 0;
  for (int i = 0; i < kWidth; ++i) {
    g2[i] = 0;
    if (f.levels)
      for (int c = 0; c < 3; ++c) g2[i] += fabs(double(f.w3[3 * i + c])) * most;
  }
  for (int i = 0; i < kWidth; ++i) {
    g1[i] = 0;
    if (f.levels)
      for (int o = 0; o < kWidth; ++o) g1[i] += fabs(double(f.w2[kWidth * i + o])) * g2[o];
  }
  for (int l = 0; l < f.levels; ++l) {
    double level = 0;
    for (int j = 0; j < kFeatures; ++j) {
      double d = 0;
      for (int o = 0; o < kWidth; ++o) d += fabs(double(f.w1[(l * kFeatures + j) * kWidth + o])) * g1[o];
      feature = max_(feature, d);
      level += d;
    }
    steepest += double(f.resolution(l)) * 2 * level * entry;  // of each coordinate: two faces of the cell
  }
  range->table = f.levels ? scale_for(feature, count) : range->base;  // entries get shares of the gradients
  // three coordinates, the contraction's slope of at most 1 / half each, and |u|, |v| <= kSupport
  range->frames = scale_for(steepest * 3 * kSupport / double(f.half), count);
}

template <class S>
__global__ void __launch_bounds__(kThreads)
    convert_kernel(int64_t n, const unsigned long long* from, const double* scale, S* to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) to[i] = exact_value<S>(from[i], *scale);
}
template <class S> void convert(int64_t n, const unsigned long long* from, const double* scale, S* to, Stream stream) {
  if (n)
    BT_LAUNCH(convert_kernel<S>, dim3(unsigned(ceil_div(n, kThreads))), dim3(kThreads), 0, stream, n, from, scale, to);
}
}  // namespace

template <class S>
ExactSums begin_exact(int64_t* memory, int64_t entries, const FieldArrays<S>* field, int64_t surfels, bool frames,
                      int64_t count, int64_t numbers, const S* gradients, Stream stream) {
  ExactSums e;
  e.table = reinterpret_cast<unsigned long long*>(memory);
  e.range = reinterpret_cast<ExactRange*>(e.table + entries);
  e.base = e.table + entries + kExactRange;
  e.frames = e.base + 3 * surfels;
  fill_zero(memory, exact_size(entries, surfels, frames), stream);
  largest(numbers, gradients, &e.range->gradient, stream);
  if (frames) largest(entries, field->table, &e.range->entry, stream);
  FieldArrays<S> f = {};
  f.half = S(1);
  if (field) f = *field;
  BT_LAUNCH(range_kernel<S>, dim3(1), dim3(1), 0, stream, f, count, e.range);
  return e;
}

template <class S>
void end_exact(const ExactSums& exact, int64_t entries, int64_t surfels, S* dtable, S* dbase, S* dframes,
               Stream stream) {
  if (dtable) convert(entries, exact.table, &exact.range->table, dtable, stream);
  if (dbase) convert(3 * surfels, exact.base, &exact.range->base, dbase, stream);
  if (dframes) convert(kFrame * surfels, exact.frames, &exact.range->frames, dframes, stream);
}

template <class S>
void sum_weights(const S* partial, int blocks, int levels, const FieldGradients<S>& out, Stream stream) {
  BT_LAUNCH(sum_weights_kernel<S>, dim3(unsigned(ceil_div(kMlpWeights, kWarp))), dim3(kThreads), 0, stream, partial,
            blocks, levels, out);
}

#define BT_INSTANTIATE(S)                                                                                      \
  template ExactSums begin_exact<S>(int64_t*, int64_t, const FieldArrays<S>*, int64_t, bool, int64_t, int64_t, \
                                    const S*, Stream);                                                         \
  template void end_exact<S>(const ExactSums&, int64_t, int64_t, S*, S*, S*, Stream);                          \
  template void sum_weights<S>(const S*, int, int, const FieldGradients<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
