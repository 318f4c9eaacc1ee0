// Residual field at points.
#include "cuda/field_device.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

template <class S>
__global__ void __launch_bounds__(kThreads)
    field_forward_kernel(int64_t n, FieldArrays<S> field, const S* __restrict__ x, S* __restrict__ rho) {
  __shared__ ForwardMlp<S> m;
  __shared__ ForwardStage<S> stage[kThreads / kWarp];
  load_mlp(field, threadIdx.x, kThreads, m);
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  Vec3<S> at = {S(0), S(0), S(0)};
  if (i < n) at = load3(x + 3 * i);
  const Vec3<S> value = evaluate(field, m, at, i < n, lane, stage[warp]);
  if (i < n) store3(rho + 3 * i, value);
}

// Warps take chunks of consecutive points in turn.
template <class S, bool kExact>
__global__ void __launch_bounds__(kBackwardWarps<S>* kWarp, kBackwardResident<S>)
    field_backward_kernel(int64_t n, FieldArrays<S> field, const S* __restrict__ x, const S* __restrict__ drho,
                          S* dtable, ExactSums exact, S* partial, S* dx) {
  BT_DYNAMIC_SHARED(BackwardShared<S>, shared);
  load_mlp(field, threadIdx.x, kBackwardWarps<S> * kWarp, shared->mlp);
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t step = int64_t(gridDim.x) * kBackwardWarps<S> * kChunk;
  const Adder<S, kExact> table = adder<kExact>(dtable, exact);
  WeightSums<S> weights;
  for (int64_t chunk = (int64_t(blockIdx.x) * kBackwardWarps<S> + warp) * kChunk; chunk < n; chunk += step)
    for (int64_t first = chunk; first < chunk + kChunk && first < n; first += kWarp) {
      const int64_t i = first + lane;
      const bool active = i < n;
      const Vec3<S> zero = {S(0), S(0), S(0)};
      const Vec3<S> at = active ? load3(x + 3 * i) : zero, d = active ? load3(drho + 3 * i) : zero;
      const Vec3<S> g =
          field_vjp(field, shared->mlp, at, d, active, lane, shared->stage[warp], weights, table, dx != nullptr);
      if (dx && active) store3(dx + 3 * i, g);
    }
  store_weight_sums(*shared, weights, warp, lane, partial);
}

// Adds up the blocks' weight gradients. 32 columns per block: 8 groups of threads sum rows, then the groups are added
// in order.
constexpr int kSumThreads = 256, kSumRows = kSumThreads / kWarp;
template <class S>
__global__ void __launch_bounds__(kSumThreads)
    sum_weights_kernel(const S* partial, int blocks, int levels, FieldGradients<S> out) {
  __shared__ S sums[kSumRows][kWarp];
  const int column = int(blockIdx.x) * kWarp + int(threadIdx.x) % kWarp, group = int(threadIdx.x) / kWarp;
  S total = S(0);
  if (column < kMlpWeights)
    for (int b = group; b < blocks; b += kSumRows) total += partial[int64_t(b) * kMlpWeights + column];
  sums[group][threadIdx.x % kWarp] = total;
  __syncthreads();
  if (group || column >= kMlpWeights) return;
  for (int g = 1; g < kSumRows; ++g) total += sums[g][threadIdx.x];
  constexpr int kMatrix = kWidth * kWidth;
  if (column < levels * kFeatures * kWidth) out.w1[column] = total;
  if (column >= kMatrix && column < 2 * kMatrix) out.w2[column - kMatrix] = total;
  if (column >= 2 * kMatrix) out.w3[column - 2 * kMatrix] = total;
}
}  // namespace

template <class S> void field_forward(const FieldForward<S>& a, Stream stream) {
  if (!a.n) return;
  BT_LAUNCH(field_forward_kernel<S>, dim3(unsigned(ceil_div(a.n, kThreads))), dim3(kThreads), 0, stream, a.n, *a.field,
            a.x, a.rho);
}

template <class S> void field_backward(const FieldBackward<S>& a, Stream stream) {
  const FieldArrays<S>& field = *a.field;
  S* const dtable = a.dfield.table;
  const int64_t entries = field.table_size();
  const int blocks = backward_blocks<S>(a.n);
  const size_t shared = sizeof(BackwardShared<S>);
  ExactSums exact;
  if (a.exact)
    exact = begin_exact(a.exact, entries, &field, a.n, 3 * a.n, a.drho, stream);
  else
    fill_zero(dtable, entries, stream);
  const auto kernel = a.exact ? field_backward_kernel<S, true> : field_backward_kernel<S, false>;
  BT_ALLOW_SHARED(kernel, shared);
  BT_LAUNCH(kernel, dim3(blocks), dim3(kBackwardWarps<S> * kWarp), shared, stream, a.n, field, a.x, a.drho, dtable,
            exact, a.mlp, a.dx);
  if (a.exact) end_exact(exact, entries, dtable, stream);
  BT_LAUNCH(sum_weights_kernel<S>, dim3(unsigned(ceil_div(kMlpWeights, kWarp))), dim3(kSumThreads), 0, stream, a.mlp,
            blocks, field.levels, a.dfield);
}

#define BT_INSTANTIATE(S)                                      \
  template void field_forward(const FieldForward<S>&, Stream); \
  template void field_backward(const FieldBackward<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
