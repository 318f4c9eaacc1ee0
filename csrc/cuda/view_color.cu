// View colours of surfels, one thread each. Spherical Voronoi with 7 sites reads 196 bytes per visible surfel for 330
// operations, backward 392 bytes for 550: memory-bound. A thread's numbers are contiguous, so a warp reads whole lines,
// a few numbers of each at a time, and finds the rest in L1.
#include <type_traits>

#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

template <class S, class ViewColor, int kTerms> struct WholeColor {
  ViewColorArrays<const S> p;
  __device__ Vec3<S> operator()(int64_t i, Vec3<S> d) const {
    return view_color<ViewColor>(kTerms ? kTerms : p.terms, p, i, d);
  }
};
// A single-colour surfel reads 20 bytes; each term 24 more (sv).
template <class S> struct LeanColor {
  LeanColors<S> p;
  __device__ Vec3<S> operator()(int64_t i, Vec3<S> d) const { return view_color(p, i, d); }
};

template <class S, class Color>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(int64_t n, Color color, const S* __restrict__ means, const double* __restrict__ center,
                   const uint8_t* __restrict__ active, S* __restrict__ out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  Vec3<S> c = {S(0), S(0), S(0)};
  if (active[i]) c = color(i, view_direction(means + 3 * i, center).n);
  store3(out + 3 * i, c);
}

template <class S, class ViewColor, int kTerms>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(int64_t n, ViewColorArrays<const S> p, const S* __restrict__ means,
                    const double* __restrict__ center, const uint8_t* __restrict__ active, const S* __restrict__ dout,
                    ViewColorArrays<S> dp, S* __restrict__ dmeans) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  const int K = kTerms ? kTerms : p.terms;
  if (!active[i]) {
    const ViewColorWidths w = ViewColor::widths(K);
    for (int k = 0; k < w.a; ++k) dp.a[w.a * i + k] = S(0);
    for (int k = 0; k < w.b; ++k) dp.b[w.b * i + k] = S(0);
    for (int k = 0; k < w.c; ++k) dp.c[w.c * i + k] = S(0);
    store3(dmeans + 3 * i, Vec3<S>{S(0), S(0), S(0)});
    return;
  }
  const Unit<S> d = view_direction(means + 3 * i, center);
  const Vec3<S> dd = view_color_vjp<ViewColor>(K, p, i, d.n, load3(dout + 3 * i), dp);
  store3(dmeans + 3 * i, normalize_vjp(d, dd));
}

// Calls f with the kind's struct, and its preset's number of terms, for unrolled loops, or 0 for any other.
template <class F> void dispatch(int kind, int terms, F&& f) {
  for_view_color(kind, [&](auto view_color) {
    constexpr int kPreset = decltype(view_color)::kPresetTerms;
    if (terms == kPreset)
      f(view_color, std::integral_constant<int, kPreset>());
    else
      f(view_color, std::integral_constant<int, 0>());
  });
}
}  // namespace

template <class S> void view_color_forward(const ViewColorForward<S>& a, Stream stream) {
  const Directions<S>& to = a.to;
  if (!to.n) return;
  const auto write = [&](auto color) {
    const auto kernel = forward_kernel<S, decltype(color)>;
    BT_LAUNCH(kernel, dim3(unsigned(ceil_div(to.n, kThreads))), dim3(kThreads), 0, stream, to.n, color, to.means,
              to.center, to.active, a.out);
  };
  if (a.colors.lean.base) return write(LeanColor<S>{a.colors.lean});
  dispatch(a.colors.whole.kind, a.colors.whole.terms, [&](auto kind, auto terms) {
    write(WholeColor<S, decltype(kind), decltype(terms)::value>{a.colors.whole});
  });
}

template <class S> void view_color_backward(const ViewColorBackward<S>& a, Stream stream) {
  const Directions<S>& to = a.to;
  if (!to.n) return;
  dispatch(a.colors.kind, a.colors.terms, [&](auto kind, auto terms) {
    const auto kernel = backward_kernel<S, decltype(kind), decltype(terms)::value>;
    BT_LAUNCH(kernel, dim3(unsigned(ceil_div(to.n, kThreads))), dim3(kThreads), 0, stream, to.n, a.colors, to.means,
              to.center, to.active, a.dout, a.dcolors, a.dmeans);
  });
}

#define BT_INSTANTIATE(S)                                               \
  template void view_color_forward(const ViewColorForward<S>&, Stream); \
  template void view_color_backward(const ViewColorBackward<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
