// Gradients of the surfels from gradients of the fragments, in three kernels.
//
// dL/dsigma of a fragment needs the sum of w dL/dw over the fragments behind it in its pixel: a pass back to front with
// that sum in a register, 16 bytes per fragment. The long formulas need no order, so they run through the list one pair
// at a time with all lanes busy (in the first pass two thirds would idle) and reduce once per pair. Gradients of alpha
// texels are summed over neighbouring fragments with the same texels, then added in memory.
#include "cuda/kernels.h"
#include "cuda/mark.h"
#include "cuda/texel_sums.h"

namespace bt::cuda {

namespace {

template <class S> struct Step {
  bool mine;
  int64_t i;
  S weight, sigma, dweight;
};

template <class S>
__global__ void __launch_bounds__(kTileThreads)
    dsigma_kernel(Pairs p, FragmentArrays<S> f, const S* dweight, S* dsigma) {
  using T = FastFloatOr<S>;
  const TileThread s = tile_thread(p.width);
  T later = T(S(0));  // sum of w dL/dw
  const auto load = [&](int64_t, int32_t, bool mine, int64_t i) {
    Step<S> t = {mine, i, S(0), S(0), S(0)};
    if (mine) t.weight = f.weight[i], t.sigma = f.sigma[i], t.dweight = dweight[i];
    return t;
  };
  const auto use = [&](const Step<S>& t) {
    if (!t.mine) return;
    dsigma[t.i] = plain(blend_vjp(T(t.weight), T(abs_(t.sigma)), T(t.dweight), later));
  };
  each_fragment_back<4>(p, s, load, use);
}

template <class S, bool kAlpha, bool kExact>
__global__ void __launch_bounds__(kRunThreads) surfel_kernel(TraceBackward<S, Pairs> a, ExactSums exact) {
  using T = FastFloatOr<S>;
  const Pairs& p = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  const Run r = run(p);
  T d[kTraceSums], ax = T(S(0)), ay = T(S(0));
  BT_UNROLL
  for (int c = 0; c < kTraceSums; ++c) d[c] = T(S(0));
  S g[kGeom];
  const int64_t id = r.some ? int64_t(p.surfel[r.k]) : 0;
  load_shape(a.view.geom + id * kGeom, g);
  const RowOf row_of(p.width);
  const int own = int(r.end - r.begin), most = max_(own, __shfl_xor_sync(kFullMask, own, kRunLanes));
  for (int at = r.lane; at - r.lane < most; at += kRunLanes) {
    const bool mine = at < own;
    const int64_t i = r.begin + at;
    int32_t pixel = 0;
    S listed = S(0), gs = S(0), gu = S(0), gv = S(0), gz = S(0);
    if (mine) {
      pixel = f.pixel[i], listed = f.sigma[i];
      if (a.dweight) gs = a.dsigma[i];
      if (a.duv) gu = a.duv[i], gv = a.duv[f.total + i];
      if (a.ddepth) gz = a.ddepth[i];
    }
    __syncwarp();  // all loads are issued before any is used: one wait for all
    if constexpr (kAlpha) {
      const AlphaPatch<S> patch(a.alpha, id);
      TexelCorners<S> corners = {};
      S v = S(0), dm[1] = {S(0)};
      if (mine && patch.textured()) v = f.uv[f.total + i];
      const bool is_cut = mine && patch.textured() && is_marked(v);
      if (is_cut) {
        corners = patch.corners(f.uv[i], v);
        dm[0] = alpha_vjp(patch, corners, listed, gs, gu, gv);
      }
      if (a.dtexel_alpha)
        add_to_corners(is_cut ? patch.first + corners.at[0] : int64_t(-1), corners, dm, int(threadIdx.x) % kWarp,
                       adder<kExact>(a.dtexel_alpha, exact));
    }
    if (mine) {
      const int32_t y = row_of(pixel), x = pixel - y * p.width;
      T ddx, ddy;
      fragment_vjp<S, T>(g, a.view.near, a.rim, T(pixel_centre<S>(x) - g[kCx]), T(pixel_centre<S>(y) - g[kCy]),
                         T(listed), T(gs), T(gu), T(gv), T(gz), d, ddx, ddy);
      ax += abs_(ddx), ay += abs_(ddy);
    }
  }
  d[kShape] = ax, d[kShape + 1] = ay;
  S sums[kTraceSums];
  BT_UNROLL
  for (int c = 0; c < kTraceSums; ++c) sums[c] = plain(d[c]);
  const S sum = sum_over_run(sums, r.lane);
  if (r.some) a.partial[int64_t(p.slot[r.k]) * kTraceSums + r.lane] = sum;
}

}  // namespace

template <class S> void trace_backward(const TraceBackward<S, Pairs>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  if (a.dweight && f.total)
    BT_LAUNCH(dsigma_kernel<S>, dim3(unsigned(p.tiles())), dim3(kTileThreads), 0, stream, p, f, a.dweight, a.dsigma);
  const int64_t texels = a.dtexel_alpha ? a.alpha.texels : 0;
  const bool cuts = a.alpha.values && a.dweight, exact = cuts && texels && a.exact_alpha;
  ExactSums sums;
  if (exact)
    sums = begin_exact(a.exact_alpha, texels, static_cast<const FieldArrays<S>*>(nullptr), f.total, f.total,
                       static_cast<const S*>(a.dsigma), stream);
  else
    fill_zero(a.dtexel_alpha, texels, stream);
  const auto run = exact  ? surfel_kernel<S, true, true>
                   : cuts ? surfel_kernel<S, true, false>
                          : surfel_kernel<S, false, false>;
  if (p.pairs) BT_LAUNCH(run, run_blocks(p), dim3(kRunThreads), 0, stream, a, sums);
  if (exact) end_exact(sums, texels, a.dtexel_alpha, stream);
  sum_slots<kTraceSums>(p, static_cast<const S*>(a.partial), StoreGeomGradient<S>{a.dgeom, a.absgrad}, stream);
}

template void trace_backward(const TraceBackward<float, Pairs>&, Stream);
template void trace_backward(const TraceBackward<double, Pairs>&, Stream);

}  // namespace bt::cuda
