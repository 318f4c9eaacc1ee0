// Colours from texels, of every fragment or summed per pixel, and their backward passes: what the baked renderer shows,
// differentiable.
#include "core/texel.h"

#include "core/shading.h"
#include "cpu/kernels.h"
#include "cpu/runs.h"
#include "cpu/threads.h"

namespace bt {

template <class S>
void texel_image_forward(const TexelForward<S>& a) {
  const TexelFragments<S>& f = a.f;
  const TexelTiles<S>& table = a.table;
  const int64_t *tile_start = a.layout.start, tiles = a.layout.tiles;
  const S bound = a.bound;
  S* image = a.image;
  std::fill(image, image + 3 * a.pixels, S(0));
  parallel_tiles(tile_start, tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t i = tile_start[first]; i < tile_start[last];) {
      const int32_t id = f.surfel[i];
      const TexelPatch<S> patch(table, id);
      for (; i < tile_start[last] && f.surfel[i] == id; ++i) {
        Vec3<S> c = patch.view;
        if (patch.textured() && f.weight[i] >= bound) c = patch.color(patch.corners(f.uv[i], f.uv[f.count + i]));
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
  const FragmentRuns runs{f.surfel, a.runs.start, a.runs.tiles};
  const S *base = table.base, *dimage = a.dimage, bound = a.bound;
  S *dtexels = a.dtexels, *dbase = a.dbase;
  if (dbase) std::fill(dbase, dbase + 3 * table.n, S(0));
  for_surfels(runs, a.order, [&](int64_t first, int64_t last) {
    const int64_t id = runs.surfel(a.order[first]);
    const TexelPatch<S> patch(table, id);
    for (int64_t r = first; r < last; ++r) {
      Vec3<S> sum = {S(0), S(0), S(0)};
      for (int64_t i = runs.start[a.order[r]]; i < runs.start[a.order[r] + 1]; ++i) {
        Vec3<S> g = f.weight[i] * load3(dimage + 3 * int64_t(f.pixel[i]));
        if (patch.textured() && f.weight[i] >= bound) {
          const auto corners = patch.corners(f.uv[i], f.uv[f.count + i]);
          g = residual_gradient(patch.color(corners), g);
          if (dtexels) texel_fetch_vjp(corners, g, dtexels + 3 * patch.first);
        }
        sum = sum + g;
      }
      if (!dbase) continue;
      store3(dbase + 3 * id, load3(dbase + 3 * id) + base_gradient(load3(base + 3 * id), sum));
    }
  });
}

template <class S>
void texel_colors_forward(const TexelColorsForward<S>& a) {
  const FragmentArrays<S>& f = a.of.f;
  parallel_parts(f.total, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end;) {
      const int32_t id = f.surfel[i];
      const TexelPatch<S> patch(a.of.table, id);
      for (; i < end && f.surfel[i] == id; ++i) {
        Vec3<S> c = patch.view;
        if (patch.textured() && f.weight[i] >= a.of.bound) c = patch.color(patch.corners(f.uv[i], f.uv[f.total + i]));
        store3(a.colors + 3 * i, c);
      }
    }
  });
}

template <class S>
void texel_colors_backward(const TexelColorsBackward<S>& a) {
  const FragmentArrays<S>& f = a.of.f;
  const TexelTiles<S>& table = a.of.table;
  S *duv = a.duv, *dtexels = a.dtexels, *dbase = a.dbase, *moved = a.moved;
  if (dbase) std::fill(dbase, dbase + 3 * table.n, S(0));
  if (dtexels) std::fill(dtexels, dtexels + 3 * table.texels, S(0));
  if (duv) std::fill(duv, duv + 2 * f.total, S(0));
  const std::vector<int64_t> start = run_starts(f.surfel, f.total);
  const FragmentRuns runs{f.surfel, start.data(), int64_t(start.size()) - 1};
  const std::vector<int64_t> order = by_surfel(runs, table.n);
  for_surfels(runs, order.data(), [&](int64_t first, int64_t last) {
    const int64_t id = runs.surfel(order[first]);
    const TexelPatch<S> patch(table, id);
    thread_local std::vector<S> own;  // the tile's gradient, where it is not kept
    const int64_t area = int64_t(patch.size[0]) * patch.size[1];
    if (moved) own.assign(3 * area, S(0));
    S* dtile = moved ? own.data() : dtexels ? dtexels + 3 * patch.first : nullptr;
    Vec3<S> sum = {S(0), S(0), S(0)};
    for (int64_t r = first; r < last; ++r)
      for (int64_t i = start[order[r]]; i < start[order[r] + 1]; ++i) {
        const Vec3<S> g = residual_gradient(load3(a.colors + 3 * i), load3(a.dcolors + 3 * i));
        sum = sum + g;
        if (!patch.textured() || f.weight[i] < a.of.bound) continue;
        const auto corners = patch.corners(f.uv[i], f.uv[f.total + i]);
        if (dtile) texel_fetch_vjp(corners, g, dtile);
        if (duv) patch.uv_vjp(corners, g, duv[i], duv[f.total + i]);
      }
    if (dbase) store3(dbase + 3 * id, base_gradient(load3(table.base + 3 * id), sum));
    if (moved) move_texels(moved + 3 * patch.first, dtile, 3, a.rate, a.share + patch.first, area);
  });
}

#define BT_INSTANTIATE(S)                                           \
  template void texel_image_forward(const TexelForward<S>&);        \
  template void texel_image_backward(const TexelBackward<S>&);      \
  template void texel_colors_forward(const TexelColorsForward<S>&); \
  template void texel_colors_backward(const TexelColorsBackward<S>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
