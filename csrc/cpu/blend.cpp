// Shading and blending of surfels with or without texels in one pass over the fragments, and its backward pass: colours
// and their gradients are never listed.
#include "ops/blend.h"

#include "cpu/kernels.h"
#include "cpu/patch.h"
#include "cpu/runs.h"

namespace bt {

namespace {
// A view as the kernels of the CPU take it.
template <class S>
using Blended = BlendedSurfels<S, TileStarts>;
template <class S>
using Forward = BlendForward<S, TileStarts>;
template <class S>
using Backward = BlendBackward<S, TileStarts>;

template <class S>
BT_HD Four<S> depth_normal(S depth, const S* g) {
  return {Quad<S>{depth, g[kNx], g[kNx + 1], g[kNx + 2]}};
}

// Behind the last fragment from i on that is of the same surfel.
inline int64_t run_end(const int32_t* surfel, int64_t i, int64_t end) {
  const int32_t id = surfel[i];
  while (++i < end && surfel[i] == id) {
  }
  return i;
}

// constant(i) for those fragments of a surfel from i on that show no texel, and textured(i, few, j) for the others:
// few's fragment j.
template <class S, class Constant, class WithTexel>
BT_HD void each_fragment(const Blended<S>& of, const TexelPatch<S>& patch, int64_t i, int64_t end, Constant&& constant,
                         WithTexel&& textured) {
  if (!patch.textured()) {
    for (; i < end; ++i) constant(i);
    return;
  }
  const FragmentArrays<S>& f = of.fragments.f;
  PatchFragments<S> few(patch);
  for (int64_t next; i < end; i = next) {
    next = std::min<int64_t>(end, i + kFew);
    const Textured here(f.weight + i, int(next - i), of.bound);
    few.look(f.uv + i, f.uv + f.total + i, int(next - i));
    for (int k = 0; k < here.others; ++k) constant(i + here.other[k]);
    for (int k = 0; k < here.count; ++k) textured(i + here.at[k], few, here.at[k]);
  }
}

template <bool kMaps, class S>
BT_HD void blend_into(const Forward<S>& a, int64_t i, Four<S> color, const S* g) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  const FragmentArrays<S>& f = a.of.fragments.f;
  S* to = a.image + int64_t(f.pixel[i]) * channels;
  add_blended<kMaps>(f.weight[i], color, g[kBeta], depth_normal(f.depth[i], g), to);
}

template <bool kMaps, class S>
void forward(const Forward<S>& a) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  const int64_t *tile_start = a.of.fragments.layout.start, tiles = a.of.fragments.layout.tiles;
  std::fill(a.image, a.image + a.of.numbers(), S(0));
  parallel_tiles(tile_start, tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t i = tile_start[first], end; i < tile_start[last]; i = end) {
      end = run_end(f.surfel, i, tile_start[last]);
      const TexelPatch<S> patch(a.of.table, f.surfel[i]);
      const S* g = a.of.geom + int64_t(f.surfel[i]) * kGeom;
      const Four<S> view(patch.view, S(1));
      each_fragment(
          a.of, patch, i, end, [&](int64_t at) { blend_into<kMaps>(a, at, view, g); },
          [&](int64_t at, const PatchFragments<S>& few, int j) {
            blend_into<kMaps>(a, at, shaded(view, few.texels(j).mix()), g);
          });
    }
  });
}

// What the fragments of a surfel add to its gradients: view colour, beta, and the normal with maps.
template <class S>
struct Sums {
  Four<S> view = Four<S>(S(0)), normal = Four<S>(S(0));  // beside them nothing, and nothing before the normal
  S beta = S(0);
};

// The gradients of one fragment but those of u and v; returns that of its colour.
template <bool kMaps, class S>
BT_HD Four<S> fragment_backward(const Backward<S>& a, int64_t i, Four<S> color, const S* g, Sums<S>& sums) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  const FragmentArrays<S>& f = a.of.fragments.f;
  const S w = f.weight[i];
  const S* row = a.dimage + int64_t(f.pixel[i]) * channels;
  a.dweight[i] = weight_gradient<kMaps>(row, color, g[kBeta], depth_normal(f.depth[i], g));
  sums.beta += w * row[4];
  if constexpr (kMaps) {
    const Four<S> dmaps = Four<S>::load(row + 5);
    a.ddepth[i] = w * dmaps.v[0];
    sums.normal = sums.normal + w * dmaps;
  }
  const Four<S> dcolor = without_last(residual_gradient(color, w * Four<S>::load(row)));
  sums.view = sums.view + dcolor;
  return dcolor;
}

// Those of fragments of one surfel from i on. `rows`: gradients of its texels, rows of four; null: there are none.
template <bool kMaps, class S>
void run_backward(const Backward<S>& a, int64_t i, int64_t end, const TexelPatch<S>& patch, S* rows, Sums<S>& sums) {
  const int64_t total = a.of.fragments.f.total;
  const S* g = a.of.geom + int64_t(a.of.fragments.f.surfel[i]) * kGeom;
  const Four<S> view(patch.view, S(1));
  each_fragment(
      a.of, patch, i, end,
      [&](int64_t at) {
        fragment_backward<kMaps>(a, at, view, g, sums);
        if (a.duv) a.duv[at] = a.duv[total + at] = S(0);
      },
      [&](int64_t at, const PatchFragments<S>& few, int j) {
        const TexelFours<S> texels = few.texels(j);
        const Four<S> dcolor = fragment_backward<kMaps>(a, at, shaded(view, texels.mix()), g, sums);
        if (rows) few.add_gradient(j, texels, dcolor, rows);
        if (!a.duv) return;
        a.duv[at] = few.gradient_u(j, texels, dcolor);
        a.duv[total + at] = few.gradient_v(j, texels, dcolor);
      });
}

// Writes the gradients of a surfel.
template <class S>
void surfel_backward(const Backward<S>& a, int64_t id, const Sums<S>& sums) {
  store3(a.dbase + 3 * id, base_gradient(load3(a.of.table.base + 3 * id), sums.view.three()));
  S* dgeom = a.dgeom + id * kGeom;
  dgeom[kBeta] = sums.beta;
  for (int k = 0; k < 3; ++k) dgeom[kNx + k] = sums.normal.v[k + 1];
}

// Asks for what the runs after run k of `runs` read: they lie all over the list, and waiting for them would take most
// of the time. First for where they begin, then for their fragments, then for the pixels of these. Always inlined: GCC
// drops calls of a function that does nothing else.
template <int channels, class S>
BT_HD void ask_for_next(const Backward<S>& a, const Runs& runs, int64_t k) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  constexpr int64_t line = 64 / sizeof(S);
  const auto run = [&](int64_t ahead) { return runs.start + runs.order[std::min(k + ahead, runs.count - 1)]; };
  __builtin_prefetch(run(8));
  const int64_t* next = run(3);
  for (int64_t i = next[0]; i < next[1]; i += line) {
    __builtin_prefetch(f.weight + i), __builtin_prefetch(f.pixel + i);
    __builtin_prefetch(f.uv + i), __builtin_prefetch(f.uv + f.total + i);
  }
  next = run(1);
  for (int64_t i = next[0]; i < next[1]; ++i) __builtin_prefetch(a.dimage + int64_t(f.pixel[i]) * channels);
}

// Surfel after surfel: a thread adds to the tiles of its own. Also where they do not learn, so that the gradients of
// the surfels are the same.
template <bool kMaps, class S>
void backward_by_surfel(const Backward<S>& a) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  const FoundRuns found(f.surfel, f.total, a.of.table.n);
  const Runs runs{f.surfel, found.start.data(), found.order.data(), int64_t(found.order.size())};
  for_surfels(runs, [&](int64_t first, int64_t last) {
    const int64_t id = runs.id(first);
    const TexelPatch<S> patch(a.of.table, id);
    thread_local std::vector<S> own;  // gradients of the texels, rows of four
    const int64_t area = a.moved || a.dtexels ? int64_t(patch.size[0]) * patch.size[1] : 0;
    own.assign(4 * area, S(0));
    Sums<S> sums;
    for (int64_t r = first; r < last; ++r) {
      ask_for_next<kMaps ? kMapChannels : kImageChannels>(a, runs, r);
      const int64_t* start = runs.start + runs.order[r];
      run_backward<kMaps>(a, start[0], start[1], patch, area ? own.data() : nullptr, sums);
    }
    surfel_backward(a, id, sums);
    if (a.dtexels)
      for (int64_t t = 0; t < area; ++t) store3(a.dtexels + 3 * (patch.first + t), load3(own.data() + 4 * t));
    if (a.moved) move_texels(a.moved + 3 * patch.first, own.data(), 4, a.rate, a.share + patch.first, area);
  });
}

// In the order of the list, which is faster where there are no tiles.
template <bool kMaps, class S>
void backward_by_list(const Backward<S>& a) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  const int64_t *tile_start = a.of.fragments.layout.start, tiles = a.of.fragments.layout.tiles, n = a.of.table.n;
  std::vector<std::vector<Sums<S>>> partial(std::max(num_threads(), 1));
  const int parts = parallel_tiles(tile_start, tiles, 64, [&](int part, int64_t first, int64_t last) {
    std::vector<Sums<S>>& own = partial[part];
    own.assign(n, {});
    for (int64_t i = tile_start[first], end; i < tile_start[last]; i = end) {
      end = run_end(f.surfel, i, tile_start[last]);
      const TexelPatch<S> patch(a.of.table, f.surfel[i]);
      run_backward<kMaps, S>(a, i, end, patch, nullptr, own[f.surfel[i]]);
    }
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t id = begin; id < end; ++id) {
      Sums<S> sums = partial[0][id];
      for (int p = 1; p < parts; ++p) {
        sums.view = sums.view + partial[p][id].view, sums.normal = sums.normal + partial[p][id].normal;
        sums.beta += partial[p][id].beta;
      }
      surfel_backward(a, id, sums);
    }
  });
}

template <bool kMaps, class S>
void backward(const Backward<S>& a) {
  const TexelTiles<S>& table = a.of.table;
  std::fill(a.dgeom, a.dgeom + table.n * kGeom, S(0));
  std::fill(a.dbase, a.dbase + 3 * table.n, S(0));
  if (a.dtexels) std::fill(a.dtexels, a.dtexels + 3 * table.texels, S(0));
  table.texels ? backward_by_surfel<kMaps>(a) : backward_by_list<kMaps>(a);
}
}  // namespace

template <class S>
void blend_forward(const BlendForward<S, TileStarts>& a) {
  a.of.maps ? forward<true>(a) : forward<false>(a);
}
template <class S>
void blend_backward(const BlendBackward<S, TileStarts>& a) {
  a.of.maps ? backward<true>(a) : backward<false>(a);
}

#define BT_INSTANTIATE(S)                                          \
  template void blend_forward(const BlendForward<S, TileStarts>&); \
  template void blend_backward(const BlendBackward<S, TileStarts>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
