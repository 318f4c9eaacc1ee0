// Projection of all surfels, tile lists, and the number of threads.
#include <numeric>

#include "core/visibility.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
int g_threads = 0;
}

int num_threads() {
  if (g_threads > 0) return g_threads;
#if defined(_OPENMP)
  return omp_get_max_threads();
#else
  return 1;
#endif
}
void set_num_threads(int n) { g_threads = n; }

template <class S>
void project_forward(const ProjectForward<S>& a) {
  const Pinhole<S> cam = pinhole(a.viewmat, a.K);
  std::vector<int64_t> broken(num_threads(), 0);
  const Resize<S> to{a.photo_pixel};
  with_kernel(a.through_pixel, float(a.photo_pixel), [&](auto kernel) {
    parallel_parts(a.surfels.n, 1024, [&](int thread, int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i)
        broken[thread] += !project_visible<decltype(kernel)>(cam, a.width, a.height, a.surfels, i, a.near, to, a.geom,
                                                             a.frames, a.radii);
    });
  });
  *a.broken += int32_t(std::accumulate(broken.begin(), broken.end(), int64_t(0)));
}

template <class S>
void project_backward(const ProjectBackward<S>& a) {
  const Pinhole<S> cam = pinhole(a.viewmat, a.K);
  parallel_parts(a.surfels.n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      project_vjp(cam, a.surfels, i, a.geom + i * kGeom, a.dgeom + i * kGeom,
                  a.dframes ? a.dframes + i * kFrame : nullptr, a.out);
  });
}

namespace {
// The tile that holds the box of a surfel, as most of small ones: no row of it has to be looked at. -1: there are more.
template <class S>
int only_tile(const S* g, const S* radii, const Bins& bins) {
  const S x = g[kCx] - S(0.5), y = g[kCy] - S(0.5), side = S(kTile);
  const S column = floor_((x - radii[0]) / side), row = floor_((y - radii[1]) / side);
  if (!(column >= S(0) && row >= S(0) && column < S(bins.tiles_x) && row < S(bins.tiles_y))) return -1;
  if (!(x + radii[0] < (column + S(1)) * side - S(1) && y + radii[1] < (row + S(1)) * side - S(1))) return -1;
  return int(row) * bins.tiles_x + int(column);
}

template <class Kernel, class S>
void bin(const View<S>& view, Bins& bins) {
  const S *geom = view.geom, *radii = view.radii;
  const int64_t n = view.n;
  const int width = view.width, height = view.height;
  const double sharp = double(Resize<S>(view.photo_pixel).sharp);
  bins.tiles_x = tiles_across(width), bins.tiles_y = tiles_across(height);
  const int64_t tiles = int64_t(bins.tiles_x) * bins.tiles_y;
  // front to back once for all tiles; equal depths keep their order
  std::vector<std::pair<S, int32_t>> order;
  order.reserve(n);
  for (int64_t i = 0; i < n; ++i)
    if (radii[2 * i] > S(0)) order.emplace_back(geom[i * kGeom + kZ], int32_t(i));
  std::sort(order.begin(), order.end());
  // each thread counts and later fills its own run of the order: the lists come out sorted
  const int64_t visible = int64_t(order.size());
  const int parts = std::max(1, int(std::min<int64_t>(num_threads(), visible / 512)));
  std::vector<std::vector<int32_t>> touched(parts);
  std::vector<std::vector<int64_t>> at(parts, std::vector<int64_t>(tiles, 0));
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) {
    std::vector<int32_t>& list = touched[t];
    list.reserve(8 * (visible / parts + 1));
    for (int64_t k = visible * t / parts; k < visible * (t + 1) / parts; ++k) {
      const size_t head = list.size();
      list.push_back(0);
      const int only = only_tile(geom + int64_t(order[k].second) * kGeom, radii + 2 * int64_t(order[k].second), bins);
      if (only >= 0) {
        list.push_back(only), list[head] = 1;
        ++at[t][only];
        continue;
      }
      for_tile_rows<Kernel>(
          geom + int64_t(order[k].second) * kGeom, width, height,
          [&](int row, int first, int last) {
            for (int tile = row * bins.tiles_x + first; tile <= row * bins.tiles_x + last; ++tile) {
              list.push_back(tile);
              ++at[t][tile];
            }
          },
          sharp);
      list[head] = int32_t(list.size() - head - 1);
    }
  }
  bins.start.assign(tiles + 1, 0);
  for (int64_t tile = 0; tile < tiles; ++tile) {
    int64_t next = bins.start[tile];
    for (int t = 0; t < parts; ++t) {
      const int64_t count = at[t][tile];
      at[t][tile] = next;
      next += count;
    }
    bins.start[tile + 1] = next;
  }
  bins.surfels.resize(bins.start[tiles]);
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) {
    const int32_t* p = touched[t].data();
    for (int64_t k = visible * t / parts; k < visible * (t + 1) / parts; ++k) {
      const int32_t count = *p++;
      for (int32_t j = 0; j < count; ++j) bins.surfels[at[t][*p++]++] = order[k].second;
    }
  }
}
}  // namespace

template <class S>
void bin(const View<S>& view, Bins& bins) {
  with_kernel(view.through_pixel, float(view.photo_pixel), [&](auto kernel) { bin<decltype(kernel)>(view, bins); });
}

#define BT_INSTANTIATE(S)                                    \
  template void project_forward(const ProjectForward<S>&);   \
  template void project_backward(const ProjectBackward<S>&); \
  template void bin(const View<S>&, Bins&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
