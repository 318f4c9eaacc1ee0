// Colours from texels, summed per pixel, and their backward pass: what the baked renderer shows, differentiable.
#include "core/texel.h"

#include "core/shading.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
// What the fragments of one surfel share.
template <class S>
struct Patch {
  const int32_t* size;  // r_u, r_v; 0, 0 = no tile
  int64_t first;        // texel
  S extent;
  Vec3<S> view;  // the colour without residual

  Patch(const TexelTiles<S>& tiles, int64_t id)
      : size(tiles.size + 2 * id),
        first(tiles.first[id]),
        extent(tiles.extent[id]),
        view(view_base(load3(tiles.base + 3 * id))) {}
  bool textured() const { return size[0] > 0; }
  TexelCorners<S> corners(S u, S v) const { return texel_corners(u, v, size[0], size[1], extent); }
};
}  // namespace

template <class S>
void texel_image_forward(const TexelForward<S>& a) {
  const TexelFragments<S>& f = a.f;
  const TexelTiles<S>& table = a.table;
  const int64_t *tile_start = a.layout.start, tiles = a.layout.tiles;
  const S *texels = table.values, bound = a.bound;
  S* image = a.image;
  std::fill(image, image + 3 * a.pixels, S(0));
  parallel_tiles(tile_start, tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t i = tile_start[first]; i < tile_start[last];) {
      const int32_t id = f.surfel[i];
      const Patch<S> patch(table, id);
      for (; i < tile_start[last] && f.surfel[i] == id; ++i) {
        Vec3<S> c = patch.view;
        if (patch.textured() && f.weight[i] >= bound) {
          const auto corners = patch.corners(f.uv[i], f.uv[f.count + i]);
          c = shaded(c, texel_fetch(texels + 3 * patch.first, corners));
        }
        S* to = image + 3 * int64_t(f.pixel[i]);
        store3(to, load3(to) + f.weight[i] * c);
      }
    }
  });
}

template <class S>
void texel_image_backward(const TexelBackward<S>& a) {
  const TexelFragments<S>& f = a.f;
  const TexelTiles<S>& table = a.table;
  const int64_t *run_start = a.runs.start, *order = a.order, runs = a.runs.tiles;
  const S *base = table.base, *texels = table.values, *dimage = a.dimage, bound = a.bound;
  S *dtexels = a.dtexels, *dbase = a.dbase;
  if (dbase) std::fill(dbase, dbase + 3 * table.n, S(0));
  // `order` sorts the runs by surfel. A thread takes whole surfels: their tiles are its own, nothing is added twice.
  std::vector<int64_t> cost(runs + 1, 0);
  for (int64_t r = 0; r < runs; ++r) cost[r + 1] = cost[r] + run_start[order[r] + 1] - run_start[order[r]];
  parallel_tiles(cost.data(), runs, 1 << 20, [&](int, int64_t begin, int64_t end) {
    const auto surfel = [&](int64_t r) { return f.surfel[run_start[order[r]]]; };
    while (begin > 0 && begin < runs && surfel(begin) == surfel(begin - 1)) ++begin;
    while (end < runs && surfel(end) == surfel(end - 1)) ++end;
    for (int64_t r = begin; r < end; ++r) {
      const int64_t id = surfel(r);
      const Patch<S> patch(table, id);
      Vec3<S> sum = {S(0), S(0), S(0)};
      for (int64_t i = run_start[order[r]]; i < run_start[order[r] + 1]; ++i) {
        Vec3<S> g = f.weight[i] * load3(dimage + 3 * int64_t(f.pixel[i]));
        if (patch.textured() && f.weight[i] >= bound) {
          const auto corners = patch.corners(f.uv[i], f.uv[f.count + i]);
          g = residual_gradient(shaded(patch.view, texel_fetch(texels + 3 * patch.first, corners)), g);
          if (dtexels) texel_fetch_vjp(corners, g, dtexels + 3 * patch.first);
        }
        sum = sum + g;
      }
      if (!dbase) continue;
      store3(dbase + 3 * id, load3(dbase + 3 * id) + base_gradient(load3(base + 3 * id), sum));
    }
  });
}

#define BT_INSTANTIATE(S)                                    \
  template void texel_image_forward(const TexelForward<S>&); \
  template void texel_image_backward(const TexelBackward<S>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
