// From gradients of the fragments to gradients of the surfels, in three kernels.
//
// dL/dsigma of a fragment needs the sum of w dL/dw over the fragments behind it in its pixel: a walk back to front with
// that sum in a register, 16 bytes per fragment. The long formulas then need no order any more, so they run through the
// list one pair at a time with all lanes busy (in the walk two thirds would idle) and reduce once per pair.
#include "core/kernel.h"
#include "cuda/kernels.h"

namespace bt::cuda {

namespace {

template <class S>
struct Step {
  bool mine;
  int64_t i;
  S weight, sigma, dweight;
};

template <class S>
__global__ void __launch_bounds__(kTileThreads)
    dsigma_kernel(Pairs p, FragmentArrays<S> f, const S* dweight, S* dsigma) {
  const Spot s = spot(p.width);
  S later = S(0);  // sum of w dL/dw
  const auto load = [&](int64_t, int32_t, bool mine, int64_t i) {
    Step<S> t = {mine, i, S(0), S(0), S(0)};
    if (mine) t.weight = f.weight[i], t.sigma = f.sigma[i], t.dweight = dweight[i];
    return t;
  };
  const auto use = [&](const Step<S>& t) {
    if (!t.mine) return;
    dsigma[t.i] = blend_vjp(t.weight, abs_(t.sigma), t.dweight, later);
  };
  walk<4, true>(p, s, load, use);
}

template <class Kernel, class S>
__global__ void __launch_bounds__(kRunThreads)
    surfel_kernel(const S* geom, S near, S rim, Pairs p, FragmentArrays<S> f, const S* dsigma, const S* duv,
                  const S* ddepth, S* partial) {
  const Run r = run(p);
  S d[kTraceSums];
  for (int c = 0; c < kTraceSums; ++c) d[c] = S(0);
  if (r.begin < r.end) {
    S g[kGeom], ax = S(0), ay = S(0);
    load_shape(geom + int64_t(p.surfel[r.k]) * kGeom, g);
    for (int64_t i = r.begin + r.lane; i < r.end; i += kRunLanes) {
      const int32_t y = f.pixel[i] / p.width, x = f.pixel[i] - y * p.width;
      S ddx, ddy;
      fragment_vjp<Kernel, S, S>(g, near, rim, pixel_centre<S>(x) - g[kCx], pixel_centre<S>(y) - g[kCy],
                                 low_pass_of(f.sigma[i]), dsigma ? dsigma[i] : S(0), duv ? duv[i] : S(0),
                                 duv ? duv[f.total + i] : S(0), ddepth ? ddepth[i] : S(0), d, ddx, ddy);
      ax += abs_(ddx), ay += abs_(ddy);
    }
    d[kShape] = ax, d[kShape + 1] = ay;
  }
  const S sum = sum_over_run(d, r.lane);
  if (r.some) partial[int64_t(p.slot[r.k]) * kTraceSums + r.lane] = sum;
}

template <class S>
struct PutGeometry {
  S *dgeom, *absgrad;
  __device__ void operator()(int64_t surfel, int column, S sum) const {
    dgeom[surfel * kGeom + column] = column < kShape || column == kArea ? sum : S(0);
    if (column >= kShape && column < kShape + 2) absgrad[2 * surfel + column - kShape] = sum;
  }
};
}  // namespace

template <class S>
void trace_backward(const TraceBackward<S, Pairs>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  if (a.dweight && f.total)
    BT_LAUNCH(dsigma_kernel<S>, dim3(unsigned(p.tiles())), dim3(kTileThreads), 0, stream, p, f, a.dweight, a.dsigma);
  const S* given = a.dweight ? a.dsigma : nullptr;
  if (p.pairs)
    with_kernel(a.view.through_pixel, [&](auto kernel) {
      BT_LAUNCH((surfel_kernel<decltype(kernel), S>), run_blocks(p), dim3(kRunThreads), 0, stream, a.view.geom,
                a.view.near, a.rim, p, f, given, a.duv, a.ddepth, a.partial);
    });
  sum_slots<kTraceSums>(p, static_cast<const S*>(a.partial), PutGeometry<S>{a.dgeom, a.absgrad}, stream);
}

#define BT_INSTANTIATE(S) template void trace_backward(const TraceBackward<S, Pairs>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
