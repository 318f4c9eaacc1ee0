// Projection of surfels.
#include <numeric>

#include "core/visibility.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace bt {

namespace {
using P = Lanes<float>;

// Loads surfels begin to begin + n, n <= kLanes, repeating the last one.
SurfelRow<P> surfel_lanes(const Surfels<float>& in, int64_t begin, int n) {
  SurfelRow<P> rows;
  float numbers[kLanes];
#define BT_EACH(name, count)                                                                                        \
  for (int k = 0; k < count; ++k) {                                                                                 \
    for (int lane = 0; lane < kLanes; ++lane) numbers[lane] = in.name[count * (begin + std::min(lane, n - 1)) + k]; \
    rows.name[k] = load(numbers);                                                                                   \
  }
  BT_GEOMETRY(BT_EACH)
#undef BT_EACH
  return rows;
}

// Computes project_visible (core/visibility.h) for lanes of surfels.
template <class Kernel>
Sight<P> sight(const Pinhole<float>& cam, int width, int height, const SurfelRow<P>& in, float near,
               const Resize<float>& to) {
  Sight<P> s;
  s.projected = project(cam, in, near, s.geom, s.frame);
  if constexpr (Kernel::kResized) s.projected = s.projected & resize(to, s.geom);
  const LevelExtent<P> e = level_extent<Kernel>(s.geom, width, height, double(to.sharp), kFloatRoom);
  find_seen(e.level.visible, e.conic, width, height, s);
  return s;
}

// Transposes columns of lanes to rows, 0 where not seen.
template <int columns> void store_rows(const P* from, uint32_t seen, int n, float* to) {
  float all[columns][kLanes];
  for (int k = 0; k < columns; ++k) store(all[k], from[k]);
  for (int lane = 0; lane < n; ++lane)
    for (int k = 0; k < columns; ++k) to[lane * columns + k] = seen >> lane & 1 ? all[k][lane] : 0.0f;
}

template <class Kernel>
int64_t project_lanes(const Pinhole<float>& cam, const ProjectForward<float>& a, const Resize<float>& to, int64_t begin,
                      int64_t end) {
  int64_t broken = 0;
  for (int64_t i = begin; i < end; i += kLanes) {
    const int n = int(std::min<int64_t>(kLanes, end - i));
    const SurfelRow<P> rows = surfel_lanes(a.surfels, i, n);
    const Sight<P> s = sight<Kernel>(cam, a.width, a.height, rows, a.near, to);
    const uint32_t seen = bits(s.seen), projected = bits(s.projected);
    store_rows<kGeom>(s.geom, seen, n, a.geom + i * kGeom);
    store_rows<kFrame>(s.frame, seen, n, a.frames + i * kFrame);
    store_rows<2>(s.radii, seen, n, a.radii + 2 * i);
    broken += __builtin_popcount(~(projected | bits(surfel_finite(rows))) & ((1u << n) - 1u));
  }
  return broken;
}
}  // namespace

template <class S> void project_forward(const ProjectForward<S>& a) {
  const Pinhole<S> cam = pinhole(a.viewmat, a.K);
  std::vector<int64_t> broken(num_threads(), 0);
  const Resize<S> to{a.photo_pixel};
  with_kernel(float(a.photo_pixel), [&](auto kernel) {
    parallel_parts(a.surfels.n, 1024, [&](int thread, int64_t begin, int64_t end) {
      using Kernel = decltype(kernel);
      if constexpr (std::is_same_v<S, float>)
        broken[thread] += project_lanes<Kernel>(cam, a, to, begin, end);
      else
        for (int64_t i = begin; i < end; ++i)
          broken[thread] +=
              !project_visible<Kernel>(cam, a.surfels, i, a.near, to, a.geom, a.frames, a.radii, [&](Sight<S>& s) {
                const Extent e = extent<Kernel>(s.geom, a.width, a.height, double(to.sharp));
                find_seen(e.visible, e, a.width, a.height, s);
              });
    });
  });
  *a.broken += int32_t(std::accumulate(broken.begin(), broken.end(), int64_t(0)));
}

template <class S> void project_backward(const ProjectBackward<S>& a) {
  const Pinhole<S> cam = pinhole(a.viewmat, a.K);
  parallel_parts(a.surfels.n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      project_vjp(cam, a.surfels, i, a.geom + i * kGeom, a.dgeom + i * kGeom,
                  a.dframes ? a.dframes + i * kFrame : nullptr, a.out);
  });
}

BT_INSTANTIATE(project_forward, ProjectForward)
BT_INSTANTIATE(project_backward, ProjectBackward)

}  // namespace bt
