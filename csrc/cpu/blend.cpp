// Shading and blending of surfels with or without texels in one pass over the fragments, and its backward pass: colours
// and their gradients are never listed.
#include "ops/blend.h"

#include "cpu/kernels.h"
#include "cpu/runs.h"

namespace bt {

namespace {
template <bool kMaps, class S>
void forward(const BlendForward<S>& a) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  const FragmentArrays<S>& f = a.of.fragments.f;
  const int64_t *tile_start = a.of.fragments.layout.start, tiles = a.of.fragments.layout.tiles;
  const S *geom = a.of.geom, bound = a.of.bound;
  S* image = a.image;
  std::fill(image, image + a.of.numbers(), S(0));
  parallel_tiles(tile_start, tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t i = tile_start[first]; i < tile_start[last];) {
      const int32_t id = f.surfel[i];
      const TexelPatch<S> patch(a.of.table, id);
      const S* g = geom + int64_t(id) * kGeom;
      for (; i < tile_start[last] && f.surfel[i] == id; ++i) {
        Vec3<S> c = patch.view;
        if (patch.textured() && f.weight[i] >= bound) c = patch.color(patch.corners(f.uv[i], f.uv[f.total + i]));
        S color[3];
        store3(color, c);
        add_blended<kMaps>(f.weight[i], color, g[kBeta], f.depth[i], g + kNx, image + int64_t(f.pixel[i]) * channels);
      }
    }
  });
}

// What the fragments of a surfel add to its gradients: view colour, beta, and the normal with maps.
template <class S>
struct Sums {
  Vec3<S> view = {S(0), S(0), S(0)};
  S geom[4] = {};
};

// The gradients of one fragment; `dtile` null: not those of the texels.
template <bool kMaps, class S>
void fragment_backward(const BlendBackward<S>& a, int64_t i, const TexelPatch<S>& patch, const S* g, S* dtile,
                       Sums<S>& sums) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  const FragmentArrays<S>& f = a.of.fragments.f;
  const S w = f.weight[i];
  const S* d = a.dimage + int64_t(f.pixel[i]) * channels;
  const bool textured = patch.textured() && w >= a.of.bound;
  TexelCorners<S> corners;
  Vec3<S> c = patch.view;
  if (textured) corners = patch.corners(f.uv[i], f.uv[f.total + i]), c = patch.color(corners);
  S color[3];
  store3(color, c);
  a.dweight[i] = weight_gradient<kMaps>(d, color, g[kBeta], f.depth[i], g + kNx);
  sums.geom[0] += w * d[4];
  if constexpr (kMaps) {
    a.ddepth[i] = w * d[5];
    sums.geom[1] += w * d[6], sums.geom[2] += w * d[7], sums.geom[3] += w * d[8];
  }
  const Vec3<S> dcolor = residual_gradient(c, w * load3(d));
  sums.view = sums.view + dcolor;
  S du = S(0), dv = S(0);
  if (textured) {
    if (dtile) texel_fetch_vjp(corners, dcolor, dtile);
    if (a.duv) patch.uv_vjp(corners, dcolor, du, dv);
  }
  if (a.duv) a.duv[i] = du, a.duv[f.total + i] = dv;
}

// Writes the gradients of a surfel.
template <class S>
void surfel_backward(const BlendBackward<S>& a, int64_t id, const Sums<S>& sums) {
  store3(a.dbase + 3 * id, base_gradient(load3(a.of.table.base + 3 * id), sums.view));
  for (int k = 0; k < 4; ++k) a.dgeom[id * kGeom + kBeta + k] = sums.geom[k];
}

// Surfel after surfel: a thread adds to the tiles of its own. Also where they do not learn, so that the gradients of
// the surfels are the same.
template <bool kMaps, class S>
void backward_by_surfel(const BlendBackward<S>& a) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  const FoundRuns found(f.surfel, f.total, a.of.table.n);
  const Runs runs{f.surfel, found.start.data(), found.order.data(), int64_t(found.order.size())};
  for_surfels(runs, [&](int64_t first, int64_t last) {
    const int64_t id = runs.id(first);
    const TexelPatch<S> patch(a.of.table, id);
    thread_local std::vector<S> own;  // the tile's gradient, where it is not kept
    const int64_t area = int64_t(patch.size[0]) * patch.size[1];
    if (a.moved) own.assign(3 * area, S(0));
    S* dtile = a.moved ? own.data() : a.dtexels ? a.dtexels + 3 * patch.first : nullptr;
    Sums<S> sums;
    for (int64_t r = first; r < last; ++r)
      for (int64_t i = runs.start[runs.order[r]]; i < runs.start[runs.order[r] + 1]; ++i)
        fragment_backward<kMaps>(a, i, patch, a.of.geom + id * kGeom, dtile, sums);
    surfel_backward(a, id, sums);
    if (a.moved) move_texels(a.moved + 3 * patch.first, dtile, a.rate, a.share + patch.first, area);
  });
}

// In the order of the list, which is faster where there are no tiles.
template <bool kMaps, class S>
void backward_by_list(const BlendBackward<S>& a) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  const int64_t *tile_start = a.of.fragments.layout.start, tiles = a.of.fragments.layout.tiles, n = a.of.table.n;
  std::vector<std::vector<Sums<S>>> partial(std::max(num_threads(), 1));
  const int parts = parallel_tiles(tile_start, tiles, 64, [&](int part, int64_t first, int64_t last) {
    std::vector<Sums<S>>& own = partial[part];
    own.assign(n, {});
    for (int64_t i = tile_start[first]; i < tile_start[last];) {
      const int32_t id = f.surfel[i];
      const TexelPatch<S> patch(a.of.table, id);
      Sums<S> sums = own[id];
      for (; i < tile_start[last] && f.surfel[i] == id; ++i)
        fragment_backward<kMaps, S>(a, i, patch, a.of.geom + int64_t(id) * kGeom, nullptr, sums);
      own[id] = sums;
    }
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t id = begin; id < end; ++id) {
      Sums<S> sums = partial[0][id];
      for (int p = 1; p < parts; ++p) {
        sums.view = sums.view + partial[p][id].view;
        for (int k = 0; k < 4; ++k) sums.geom[k] += partial[p][id].geom[k];
      }
      surfel_backward(a, id, sums);
    }
  });
}

template <bool kMaps, class S>
void backward(const BlendBackward<S>& a) {
  const TexelTiles<S>& table = a.of.table;
  std::fill(a.dgeom, a.dgeom + table.n * kGeom, S(0));
  std::fill(a.dbase, a.dbase + 3 * table.n, S(0));
  if (a.dtexels) std::fill(a.dtexels, a.dtexels + 3 * table.texels, S(0));
  table.texels ? backward_by_surfel<kMaps>(a) : backward_by_list<kMaps>(a);
}
}  // namespace

template <class S>
void blend_forward(const BlendForward<S>& a) {
  a.of.maps ? forward<true>(a) : forward<false>(a);
}
template <class S>
void blend_backward(const BlendBackward<S>& a) {
  a.of.maps ? backward<true>(a) : backward<false>(a);
}

#define BT_INSTANTIATE(S)                              \
  template void blend_forward(const BlendForward<S>&); \
  template void blend_backward(const BlendBackward<S>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
