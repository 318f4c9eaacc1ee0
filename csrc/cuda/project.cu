// Projection of all surfels: one thread per surfel.
#include "core/visibility.h"
#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

template <class Kernel, class S>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(const S* viewmat, const S* K, int width, int height, S near, Surfels<S> in, S* geom, S* frames,
                   S* radii, int32_t* broken) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.n) return;
  const Pinhole<S> cam = pinhole(viewmat, K);
  if (!project_visible<Kernel>(cam, width, height, in, i, near, geom, frames, radii)) atomicAdd(broken, 1);
}

template <class S>
__global__ void __launch_bounds__(kThreads) backward_kernel(const S* viewmat, const S* K, Surfels<S> in, const S* geom,
                                                            const S* dgeom, const S* dframes, SurfelGradients<S> out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.n) return;
  const Pinhole<S> cam = pinhole(viewmat, K);
  project_vjp(cam, in, i, geom + i * kGeom, dgeom + i * kGeom, dframes ? dframes + i * kFrame : nullptr, out);
}
}  // namespace

template <class S>
void project_forward(bool through_pixel, const S* viewmat, const S* K, int width, int height, S near,
                     const Surfels<S>& in, S* geom, S* frames, S* radii, int32_t* broken, Stream stream) {
  if (!in.n) return;
  with_kernel(through_pixel, [&](auto kernel) {
    BT_LAUNCH((forward_kernel<decltype(kernel), S>), dim3(unsigned(ceil_div(in.n, kThreads))), dim3(kThreads), 0,
              stream, viewmat, K, width, height, near, in, geom, frames, radii, broken);
  });
}
template <class S>
void project_backward(const S* viewmat, const S* K, const Surfels<S>& in, const S* geom, const S* dgeom,
                      const S* dframes, const SurfelGradients<S>& out, Stream stream) {
  if (!in.n) return;
  BT_LAUNCH(backward_kernel<S>, dim3(unsigned(ceil_div(in.n, kThreads))), dim3(kThreads), 0, stream, viewmat, K, in,
            geom, dgeom, dframes, out);
}

#define BT_INSTANTIATE(S)                                                                                          \
  template void project_forward<S>(bool, const S*, const S*, int, int, S, const Surfels<S>&, S*, S*, S*, int32_t*, \
                                   Stream);                                                                        \
  template void project_backward<S>(const S*, const S*, const Surfels<S>&, const S*, const S*, const S*,           \
                                    const SurfelGradients<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
