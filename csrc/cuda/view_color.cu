// View colours of surfels, one thread each. Spherical Voronoi with 7 sites reads 196 bytes per visible surfel for 330
// operations, backward 392 bytes for 550: memory-bound. A thread's numbers are contiguous, so a warp reads whole lines,
// a few numbers of each at a time, and finds the rest in L1.
#include <type_traits>

#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

// kTerms: the number of terms, 0: that of the colours; without a kind the colours are reduced: a single-colour surfel
// reads 20 bytes; each term 24 more (sv).
template <class S, class ViewColor, int kTerms>
__global__ void __launch_bounds__(kThreads) forward_kernel(ViewColorForward<S> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= a.to.n) return;
  Vec3<S> c = {S(0), S(0), S(0)};
  if (a.to.active[i]) {
    const Vec3<S> d = view_direction(a.to.means + 3 * i, a.to.center).n;
    if constexpr (std::is_void_v<ViewColor>)
      c = view_color(a.colors.reduced, i, d);
    else
      c = view_color<ViewColor>(kTerms ? kTerms : a.colors.whole.terms, a.colors.whole, i, d);
  }
  store3(a.out + 3 * i, c);
}

template <class S, class ViewColor, int kTerms>
__global__ void __launch_bounds__(kThreads) backward_kernel(ViewColorBackward<S> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= a.to.n) return;
  const int K = kTerms ? kTerms : a.colors.terms;
  if (!a.to.active[i]) {
    const ViewColorWidths w = ViewColor::widths(K);
    const ViewColorRow<S> none = a.dcolors.row(w, i);
    for (int k = 0; k < w.a; ++k) none.a[k] = S(0);
    for (int k = 0; k < w.b; ++k) none.b[k] = S(0);
    for (int k = 0; k < w.c; ++k) none.c[k] = S(0);
    store3(a.dmeans + 3 * i, Vec3<S>{S(0), S(0), S(0)});
    return;
  }
  const Unit<S> d = view_direction(a.to.means + 3 * i, a.to.center);
  const Vec3<S> dd = view_color_vjp<ViewColor>(K, a.colors, i, d.n, load3(a.dout + 3 * i), a.dcolors);
  store3(a.dmeans + 3 * i, normalize_vjp(d, dd));
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
  if (a.colors.reduced.base) {
    BT_LAUNCH_EACH((forward_kernel<S, void, 0>), a.to.n, kThreads, stream, a);
    return;
  }
  dispatch(a.colors.whole.kind, a.colors.whole.terms, [&](auto kind, auto terms) {
    const auto kernel = forward_kernel<S, decltype(kind), decltype(terms)::value>;
    BT_LAUNCH_EACH(kernel, a.to.n, kThreads, stream, a);
  });
}

template <class S> void view_color_backward(const ViewColorBackward<S>& a, Stream stream) {
  dispatch(a.colors.kind, a.colors.terms, [&](auto kind, auto terms) {
    const auto kernel = backward_kernel<S, decltype(kind), decltype(terms)::value>;
    BT_LAUNCH_EACH(kernel, a.to.n, kThreads, stream, a);
  });
}

BT_INSTANTIATE(view_color_forward, ViewColorForward)
BT_INSTANTIATE(view_color_backward, ViewColorBackward)

}  // namespace bt::cuda
