// Gradient sums of texels over fragments, and their use. Four numbers per texel, the last that of alpha or of squares,
// or 0, for one vector reduction per texel (warp.h); or integers, for order-independent sums.
#pragma once

#include "cuda/fragment_list.h"
#include "cuda/warp.h"
#include "ops/texel.h"

namespace bt::cuda {

// Adds the gradients of each lane's four corners; g: gradient of the fetch of M channels; one addition per run of lanes
// with the same texels. row: row of the first corner in the texel list, -1: none. Sums of three channels have rows of
// four.
template <int M, class S, bool kExact>
__device__ void add_to_corners(int64_t row, const TexelCorners<S>& at, const S (&g)[M], int lane,
                               const Adder<S, kExact>& to) {
  static_assert(M == 1 || M == 3 || M == 4);
  S value[4 * M];
  BT_UNROLL
  for (int i = 0; i < 4 * M; ++i) value[i] = at.weight[i / M] * g[i % M];
  const unsigned run = run_of(row, lane);
  sum_over_run(run, lane, value);
  if (row < 0 || count_below(run, lane)) return;
  BT_UNROLL
  for (int k = 0; k < 4; ++k) {
    const int64_t texel = row + at.at[k] - at.at[0];
    const S* d = value + M * k;
    if constexpr (M == 1) {
      if (d[0] != S(0)) to.add(texel, d[0]);
    } else {
      const S four[4] = {d[0], d[1], d[2], M == 4 ? d[M - 1] : S(0)};
      if (d[0] != S(0) || d[1] != S(0) || d[2] != S(0) || four[3] != S(0)) to.add4(4 * texel, four);
    }
  }
}

constexpr int kTexelThreads = 256;
// Calls fn(texel) for the texels of surfels with a pair, i.e. all that a view can show: a warp per surfel.
template <class S, class F>
__global__ void __launch_bounds__(kTexelThreads) shown_texels_kernel(Pairs p, TexelTiles<S> tiles, F fn) {
  const int64_t r = (int64_t(blockIdx.x) * kTexelThreads + threadIdx.x) / kWarp;
  if (r >= p.surfels || p.slot_start[r] == p.slot_start[r + 1]) return;
  const int64_t id = p.order[r], first = tiles.first[id];
  const int64_t area = int64_t(tiles.size[2 * id]) * tiles.size[2 * id + 1];
  for (int64_t t = threadIdx.x % kWarp; t < area; t += kWarp) fn(first + t);
}
template <class S, class F>
void each_shown_texel(const Pairs& p, const TexelTiles<S>& tiles, const F& fn, Stream stream) {
  BT_LAUNCH_EACH((shown_texels_kernel<S, F>), p.surfels * kWarp, kTexelThreads, stream, p, tiles, fn);
}

template <class S> struct ClearTexel {
  struct alignas(16) Row {
    S v[4];
  };
  S* sums;
  __device__ void operator()(int64_t t) const { reinterpret_cast<Row*>(sums)[t] = {}; }
};
// Takes the gradient step on a texel, from its sums.
template <class S, bool kExact> struct MoveTexel {
  S* sums;
  ExactSums exact;
  const S* share;
  S rate;
  S *moved, *squares;
  __device__ void operator()(int64_t t) const {
    const Adder<S, kExact> of = adder<kExact>(sums, exact);
    const Vec3<S> g = {of.sum(4 * t), of.sum(4 * t + 1), of.sum(4 * t + 2)};
    if (g.x != S(0) || g.y != S(0) || g.z != S(0))
      store3(moved + 3 * t, texel_step(load3(moved + 3 * t), g, rate, share[t]));
    if (squares) squares[t] = texel_step(squares[t], of.sum(4 * t + 3), rate, share[t]);
  }
};

}  // namespace bt::cuda
