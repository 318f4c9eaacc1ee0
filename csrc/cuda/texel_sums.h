// Sums of the texels' gradients over fragments, and what becomes of them. Rows of four numbers per texel, the last 0,
// so that a texel takes one vector reduction (warp.h); or integers, for sums that do not depend on the order.
#pragma once

#include "cuda/exact_sums.h"
#include "ops/texel.h"

namespace bt::cuda {

// Adds the gradients of every lane's four corners, one addition per run of lanes between the same texels. Row: that of
// the first corner in the list of texels, -1 where there is none; sums have rows of four.
template <class S, bool kExact>
__device__ void add_to_texels(int64_t row, const TexelCorners<S>& at, Vec3<S> g, int lane, const Adder<S, kExact>& to) {
  S value[12];
  texel_corner_gradients(at, g, [&](int k, Vec3<S> d) { store3(value + 3 * k, d); });
  const unsigned run = run_of(row, lane);
  sum_over_run(run, lane, value);
  if (row < 0 || count_below(run, lane)) return;
  BT_UNROLL
  for (int k = 0; k < 4; ++k) {
    const S d[4] = {value[3 * k], value[3 * k + 1], value[3 * k + 2], S(0)};
    if (d[0] != S(0) || d[1] != S(0) || d[2] != S(0)) to.add4(4 * (row + at.at[k] - at.at[0]), d);
  }
}

constexpr int kFinishThreads = 256;
// Use of the sums: the gradient, or a step of the texels.
template <class S, bool kExact>
__global__ void __launch_bounds__(kFinishThreads)
    finish_texels_kernel(int64_t texels, S* sums, ExactSums exact, const S* __restrict__ share, S rate,
                         S* __restrict__ dtexels, S* __restrict__ moved) {
  const int64_t t = int64_t(blockIdx.x) * kFinishThreads + threadIdx.x;
  if (t >= texels) return;
  const Adder<S, kExact> of = adder<kExact>(sums, exact);
  const Vec3<S> g = {of.sum(4 * t), of.sum(4 * t + 1), of.sum(4 * t + 2)};
  if (dtexels) store3(dtexels + 3 * t, g);
  if (moved && (g.x != S(0) || g.y != S(0) || g.z != S(0)))
    store3(moved + 3 * t, texel_step(load3(moved + 3 * t), g, rate, share[t]));
}

// `a`: arguments with dtexels, moved, share, rate and work.
template <bool kExact, class Arguments>
void finish_texels(const Arguments& a, int64_t texels, const ExactSums& exact, Stream stream) {
  using S = std::remove_pointer_t<decltype(a.moved)>;
  const auto finish = finish_texels_kernel<S, kExact>;
  if (texels)
    BT_LAUNCH(finish, dim3(unsigned(ceil_div(texels, kFinishThreads))), dim3(kFinishThreads), 0, stream, texels,
              a.work.sums, exact, a.share, a.rate, a.dtexels, a.moved);
}

}  // namespace bt::cuda
