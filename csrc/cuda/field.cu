// The residual field at points and at texels.
#include "core/texel.h"
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
  Adder<S, kExact> table;
  if constexpr (kExact)
    table = {exact.table, exact.range->table};
  else
    table = {dtable};
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

// A warp takes 32 texels of a tile in the order of memory: a row, a part of one, or several short ones.
template <class S>
__global__ void __launch_bounds__(kThreads)
    bake_kernel(int64_t n, int64_t warps, FieldArrays<S> field, const S* __restrict__ frames,
                const S* __restrict__ extent, const int32_t* __restrict__ tiles, const int64_t* __restrict__ first,
                int width, int height, S* __restrict__ pages, int32_t* bad) {
  __shared__ ForwardMlp<S> m;
  __shared__ ForwardStage<S> stage[kThreads / kWarp];
  load_mlp(field, threadIdx.x, kThreads, m);
  const int64_t warp = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
  if (warp >= warps) return;
  int64_t low = 0, high = n;  // the last tile that begins at this warp or before it; tiles of no texels are skipped
  while (high - low > 1) {
    const int64_t mid = (low + high) / 2;
    (first[mid] <= warp ? low : high) = mid;
  }
  const int32_t* tile = tiles + 5 * low;
  const int r_u = tile[3], r_v = tile[4], lane = threadIdx.x % kWarp;
  const int t = int(warp - first[low]) * kWarp + lane;
  const bool active = t < r_u * r_v;
  const int i = active ? t % r_u : 0, j = active ? t / r_u : 0;
  const Vec3<S> x =
      world_point(frames + low * kFrame, texel_centre(i, r_u, extent[low]), texel_centre(j, r_v, extent[low]));
  Vec3<S> rho = evaluate(field, m, x, active, lane, stage[threadIdx.x / kWarp]);
  if (!active) return;
  if (!finite_(rho.x) || !finite_(rho.y) || !finite_(rho.z)) {
    rho = {S(0), S(0), S(0)};
    atomicAdd(bad, 1);
  }
  store3(pages + 3 * ((int64_t(tile[2]) * height + tile[1] + j) * width + tile[0] + i), rho);
}
}  // namespace

template <class S> void field_forward(const FieldForward<S>& a, Stream stream) {
  if (!a.n) return;
  BT_LAUNCH(field_forward_kernel<S>, dim3(unsigned(ceil_div(a.n, kThreads))), dim3(kThreads), 0, stream, a.n, *a.field,
            a.x, a.rho);
}

template <class S> void field_backward(const FieldBackward<S>& a, Stream stream) {
  const FieldArrays<S>& field = *a.field;
  const FieldGradients<S>& out = a.dfield;
  const FieldWork<S>& work = a.work;
  const int blocks = backward_blocks<S>(a.n);
  const size_t shared = sizeof(BackwardShared<S>);
  const dim3 grid(blocks), block(kBackwardWarps<S> * kWarp);
  if (work.exact) {
    const ExactSums exact = begin_exact(work.exact, field.table_size(), &field, 0, false, a.n, 3 * a.n, a.drho, stream);
    const auto kernel = field_backward_kernel<S, true>;
    BT_ALLOW_SHARED(kernel, shared);
    BT_LAUNCH(kernel, grid, block, shared, stream, a.n, field, a.x, a.drho, out.table, exact, work.mlp, a.dx);
    end_exact(exact, field.table_size(), 0, out.table, static_cast<S*>(nullptr), static_cast<S*>(nullptr), stream);
  } else {
    const auto kernel = field_backward_kernel<S, false>;
    fill_zero(out.table, field.table_size(), stream);
    BT_ALLOW_SHARED(kernel, shared);
    BT_LAUNCH(kernel, grid, block, shared, stream, a.n, field, a.x, a.drho, out.table, ExactSums(), work.mlp, a.dx);
  }
  sum_weights(work.mlp, blocks, field.levels, out, stream);
}

template <class S> void field_tiles(const FieldTiles<S>& a, Stream stream) {
  if (!a.warps) return;
  BT_LAUNCH(bake_kernel<S>, dim3(unsigned(ceil_div(a.warps * kWarp, kThreads))), dim3(kThreads), 0, stream, a.n,
            a.warps, *a.field, a.frames, a.extent, a.tiles, a.first, a.width, a.height, a.pages, a.bad);
}

#define BT_INSTANTIATE(S)                                        \
  template void field_forward(const FieldForward<S>&, Stream);   \
  template void field_backward(const FieldBackward<S>&, Stream); \
  template void field_tiles(const FieldTiles<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
