// Colours of fragments from the texels of their surfels, and their backward pass: one thread per fragment. Training
// takes blend.cu; this is for who wants the colours themselves, and for the coverage of texels.
//
// Work, single precision. For each fragment the forward pass reads 8 bytes of the list and 32 of its surfel, which its
// neighbours share, and writes 12; for a textured one it also reads 8 bytes of the list and four texels of 12. The
// backward pass reads 32 bytes of the list and of colours, for a textured fragment what the forward pass does, and
// writes 8. A textured fragment adds to four texels, one vector reduction of 16 bytes each (four atomics before compute
// capability 9.0), after sums over neighbours between the same four: in a close view many fragments lie there, and all
// of a tile of one texel do. Every texel is cleared (16 bytes) and looked at (16), and those that were seen move (28).
// A look-up is about 50 operations, with its derivatives 75: memory and additions are the limit. The backward kernel
// takes 48 registers on compute capability 9.0.
#include "cuda/kernels.h"
#include "cuda/texel_sums.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 256;

dim3 blocks_for(int64_t n) { return dim3(unsigned(ceil_div(n, kThreads))); }

template <class S>
__global__ void __launch_bounds__(kThreads) colors_kernel(TexelColors<S> of, S* __restrict__ colors) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= of.f.total) return;
  const TexelPatch<S> patch(of.table, of.f.surfel[i]);
  Vec3<S> c = patch.view;
  if (of.f.weight[i] >= of.bound && patch.textured())
    c = patch.color(patch.corners(of.f.uv[i], of.f.uv[of.f.total + i]));
  store3(colors + 3 * i, c);
}

// Null is what is not asked for; without `sums` and exact sums the texels get no gradient.
template <class S, bool kExact>
__global__ void __launch_bounds__(kThreads)
    gradient_kernel(TexelColors<S> of, const S* __restrict__ colors, const S* __restrict__ dcolors,
                    S* __restrict__ dbase, S* __restrict__ duv, S* __restrict__ sums, ExactSums exact, bool has_base,
                    bool has_texels) {
  const FragmentArrays<S>& f = of.f;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = int(threadIdx.x) % kWarp;
  const bool in = i < f.total;
  const int64_t j = in ? i : f.total - 1;  // lanes beyond the end read what others read
  const int32_t id = f.surfel[j];
  const TexelPatch<S> patch(of.table, id);
  const Vec3<S> g = residual_gradient(load3(colors + 3 * j), load3(dcolors + 3 * j));
  if (has_base) {
    Adder<S, kExact> to;
    if constexpr (kExact)
      to = {exact.base, exact.range->base};
    else
      to = {dbase};
    S d[3];
    store3(d, base_gradient(load3(of.table.base + 3 * int64_t(id)), g));
    add_to_rows(in ? id : -1, lane, d, to);
  }
  const bool textured = in && f.weight[j] >= of.bound && patch.textured();
  TexelCorners<S> at = {};
  if (textured) at = patch.corners(f.uv[i], f.uv[f.total + i]);
  if (duv && in) {
    S du = S(0), dv = S(0);
    if (textured) patch.uv_vjp(at, g, du, dv);
    duv[i] = du, duv[f.total + i] = dv;
  }
  if (!has_texels) return;
  const Adder<S, kExact> to = texel_adder<kExact>(sums, exact);
  add_to_texels(textured ? patch.first + at.at[0] : int64_t(-1), at, g, lane, to);
}

template <class S, bool kExact>
void run_backward(const TexelColorsBackward<S>& a, const ExactSums& exact, Stream stream) {
  const auto gradient = gradient_kernel<S, kExact>;
  if (a.of.f.total)
    BT_LAUNCH(gradient, blocks_for(a.of.f.total), dim3(kThreads), 0, stream, a.of, a.colors, a.dcolors, a.dbase, a.duv,
              a.work.sums, exact, a.dbase != nullptr, a.sums_texels());
  if (a.sums_texels()) finish_texels<kExact>(a, a.of.table.texels, exact, stream);
}
}  // namespace

template <class S>
void texel_colors_forward(const TexelColorsForward<S>& a, Stream stream) {
  if (a.of.f.total) BT_LAUNCH(colors_kernel<S>, blocks_for(a.of.f.total), dim3(kThreads), 0, stream, a.of, a.colors);
}

template <class S>
void texel_colors_backward(const TexelColorsBackward<S>& a, Stream stream) {
  const int64_t n = a.of.table.n, entries = a.sums_texels() ? 4 * a.of.table.texels : 0;
  if (a.work.exact) {
    const ExactSums exact = begin_exact(a.work.exact, entries, static_cast<const FieldArrays<S>*>(nullptr), n, false,
                                        a.of.f.total, 3 * a.of.f.total, a.dcolors, stream);
    run_backward<S, true>(a, exact, stream);
    end_exact(exact, static_cast<const FieldArrays<S>*>(nullptr), n, static_cast<S*>(nullptr), a.dbase,
              static_cast<S*>(nullptr), stream);
  } else {
    if (a.dbase) fill_zero(a.dbase, 3 * n, stream);
    fill_zero(a.work.sums, entries, stream);
    run_backward<S, false>(a, ExactSums(), stream);
  }
}

#define BT_INSTANTIATE(S)                                                   \
  template void texel_colors_forward(const TexelColorsForward<S>&, Stream); \
  template void texel_colors_backward(const TexelColorsBackward<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
