// Projection of surfels, one thread each.
#include "core/footprint.h"
#include "core/visibility.h"
#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

template <class S> __global__ void __launch_bounds__(kThreads) forward_kernel(ProjectForward<S> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= a.surfels.n) return;
  const Pinhole<S> cam = pinhole(a.viewmat, a.K);
  const auto mark = [&](Sight<S>& s) {
    S row[kLevelRow];
    const bool visible = level_row<LowPassKernel>(s.geom, a.near, S(1), row);
    auto [bounds, pad] = row_bounds(row, a.width, a.height);
    bounds.x0 -= pad, bounds.x1 += pad, bounds.y0 -= pad, bounds.y1 += pad;
    find_seen(visible, bounds, a.width, a.height, s);
  };
  const bool fine =
      project_visible<LowPassKernel>(cam, a.surfels, i, a.near, Resize<S>(S(1)), a.geom, a.frames, a.radii, mark);
  if (!fine) atomicAdd(a.broken, 1);
}

template <class S> __global__ void __launch_bounds__(kThreads) backward_kernel(ProjectBackward<S> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= a.surfels.n) return;
  const Pinhole<S> cam = pinhole(a.viewmat, a.K);
  project_vjp(cam, a.surfels, i, a.geom + i * kGeom, a.dgeom + i * kGeom, a.dframes ? a.dframes + i * kFrame : nullptr,
              a.out);
}
}  // namespace

template <class S> void project_forward(const ProjectForward<S>& a, Stream stream) {
  BT_LAUNCH_EACH(forward_kernel<S>, a.surfels.n, kThreads, stream, a);
}
template <class S> void project_backward(const ProjectBackward<S>& a, Stream stream) {
  BT_LAUNCH_EACH(backward_kernel<S>, a.surfels.n, kThreads, stream, a);
}

BT_INSTANTIATE(project_forward, ProjectForward)
BT_INSTANTIATE(project_backward, ProjectBackward)

}  // namespace bt::cuda
