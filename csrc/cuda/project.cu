// Projection of all surfels: a thread a surfel.
#include "core/bounds.h"
#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

template <class S>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(const S* viewmat, const S* K, int width, int height, S near, bool prefilter, Surfels<S> in, S* geom,
                   S* frames, S* radii, int32_t* broken) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.n) return;
  const Pinhole<S> cam = pinhole(viewmat, K);
  S g[kGeom], f[kFrame], r[2] = {S(0), S(0)};
  bool seen = project(cam, in.means + 3 * i, in.quats + 4 * i, in.log_scales + 2 * i, in.opacity_logits[i],
                      in.beta_raw[i], near, prefilter, g, f);
  if (seen) {
    const Extent e = extent(g);
    seen = e.visible && g[kCx] + e.x1 >= 0 && g[kCx] + e.x0 <= width && g[kCy] + e.y1 >= 0 && g[kCy] + e.y0 <= height;
    if (seen) {
      const double most = 1e6;
      r[0] = S(min_(most, max_(e.x1, -e.x0)));
      r[1] = S(min_(most, max_(e.y1, -e.y0)));
    }
  } else {
    bool finite = finite_(in.opacity_logits[i]) && finite_(in.beta_raw[i]);
    for (int k = 0; k < 3; ++k) finite &= finite_(in.means[3 * i + k]);
    for (int k = 0; k < 4; ++k) finite &= finite_(in.quats[4 * i + k]);
    for (int k = 0; k < 2; ++k) finite &= finite_(in.log_scales[2 * i + k]);
    if (!finite) atomicAdd(broken, 1);
  }
  for (int k = 0; k < kGeom; ++k) geom[i * kGeom + k] = seen ? g[k] : S(0);
  for (int k = 0; k < kFrame; ++k) frames[i * kFrame + k] = seen ? f[k] : S(0);
  radii[2 * i] = r[0], radii[2 * i + 1] = r[1];
}

template <class S>
__global__ void __launch_bounds__(kThreads) backward_kernel(const S* viewmat, const S* K, Surfels<S> in, const S* geom,
                                                            const S* dgeom, const S* dframes, SurfelGradients<S> out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.n) return;
  const S* g = geom + i * kGeom;
  S dmean[3] = {}, dquat[4] = {}, dscales[2] = {}, dopacity = S(0), dbeta = S(0);
  if (g[kZ] != S(0)) {
    const Pinhole<S> cam = pinhole(viewmat, K);
    const S none[kFrame] = {};
    project_vjp(cam, in.means + 3 * i, in.quats + 4 * i, in.log_scales + 2 * i, in.opacity_logits[i], in.beta_raw[i], g,
                dgeom + i * kGeom, dframes ? dframes + i * kFrame : none, dmean, dquat, dscales, &dopacity, &dbeta);
  }
  for (int k = 0; k < 3; ++k) out.means[3 * i + k] = dmean[k];
  for (int k = 0; k < 4; ++k) out.quats[4 * i + k] = dquat[k];
  for (int k = 0; k < 2; ++k) out.log_scales[2 * i + k] = dscales[k];
  out.opacity_logits[i] = dopacity, out.beta_raw[i] = dbeta;
}
}  // namespace

template <class S>
void project_forward(const S* viewmat, const S* K, int width, int height, S near, bool prefilter, const Surfels<S>& in,
                     S* geom, S* frames, S* radii, int32_t* broken, Stream stream) {
  if (!in.n) return;
  BT_LAUNCH(forward_kernel<S>, dim3(unsigned(ceil_div(in.n, kThreads))), dim3(kThreads), 0, stream, viewmat, K, width,
            height, near, prefilter, in, geom, frames, radii, broken);
}
template <class S>
void project_backward(const S* viewmat, const S* K, const Surfels<S>& in, const S* geom, const S* dgeom,
                      const S* dframes, const SurfelGradients<S>& out, Stream stream) {
  if (!in.n) return;
  BT_LAUNCH(backward_kernel<S>, dim3(unsigned(ceil_div(in.n, kThreads))), dim3(kThreads), 0, stream, viewmat, K, in,
            geom, dgeom, dframes, out);
}

#define BT_INSTANTIATE(S)                                                                                          \
  template void project_forward<S>(const S*, const S*, int, int, S, bool, const Surfels<S>&, S*, S*, S*, int32_t*, \
                                   Stream);                                                                        \
  template void project_backward<S>(const S*, const S*, const Surfels<S>&, const S*, const S*, const S*,           \
                                    const SurfelGradients<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
