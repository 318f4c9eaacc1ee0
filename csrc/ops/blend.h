// Arguments of shading and blending in one pass over a fragment list.
#pragma once

#include "ops/visibility.h"

namespace bt {

// Surfels of a view, with texels or without (sizes 0, 0).
template <class S, class Layout> struct BlendedSurfels {
  bool maps;
  const S* geom;  // [n, kGeom]
  int width, height;
  Fragments<S, Layout> fragments;
  S bound;
  TexelTiles<S> table;
  const S* residual;  // [F, 3] residual of each fragment, instead of texels; or null

  int64_t numbers() const { return int64_t(width) * height * channels_of(maps); }
  template <class R> void fields(R& r) {
    r.numbers("maps", maps, "width", width, "height", height, "bound", bound);
    table.fields(r);
    r.array("geom", geom, table.n * kGeom);
    fragments.fields(r, table.n, width, height);
    r.maybe("residual", residual, 3 * fragments.f.total);
    if (residual && table.texels) r.refuse("the residual is that of texels or of fragments");
  }
};

// Writes image [height, width, channels]: the sums of core/blend.h, kMapChannels with maps, else kImageChannels, of the
// colours relu(relu(base + 0.5) + residual). The residual of texels is 0 below `bound` or without a tile.
template <class S, class Layout> struct BlendForward {
  BlendedSurfels<S, Layout> of;
  S* image;

  template <class R> void fields(R& r) {
    of.fields(r);
    r.array("image", image, of.numbers());
  }
};

// Gradient sums of a pair of surfel and tile: beta and the colour, with maps also the normal and one unused.
constexpr int blend_sums(bool maps) { return maps ? 8 : 4; }

// Writes ddepth [F] (maps only), dgeom [n, kGeom] (beta and normal columns), dbase [n, 3] and, unless null, dweight
// [F], duv [2, F] and dresidual [F, 3]. Texel t of `moved` [texels, 3], which may be the texels that are read, moves by
// -rate share[t] times its gradient. squares [texels], unless null, moves likewise by the gradient of the first channel
// with each fragment multiplied by its weight once more (CUDA only: the CPU has texel_coverage). partial [pairs,
// blend_sums] and work are working memory.
template <class S, class Layout> struct BlendBackward {
  BlendedSurfels<S, Layout> of;
  const S *dimage, *share;
  S rate;
  S *partial, *dweight, *duv, *ddepth, *dgeom, *dbase, *dresidual, *moved, *squares;
  TexelWork<S> work;

  template <class R> void fields(R& r) {
    of.fields(r);
    const int64_t total = of.fragments.f.total, n = of.table.n;
    r.array("dimage", dimage, of.numbers());
    r.maybe("dweight", dweight, total);
    r.maybe("duv", duv, 2 * total);
    of.maps ? r.array("ddepth", ddepth, total) : r.maybe("ddepth", ddepth, total);
    r.array("dgeom", dgeom, n * kGeom);
    r.array("dbase", dbase, 3 * n);
    r.maybe("dresidual", dresidual, 3 * total);
    if (dresidual && !of.residual) r.refuse("there is no residual of fragments");
    r.maybe("moved", moved, 3 * of.table.texels);
    r.maybe("squares", squares, of.table.texels);
    r.maybe("share", share, of.table.texels);
    r.number("rate", rate);
    r.work("partial", partial, of.fragments.layout.pairs * blend_sums(of.maps));
    work.fields(r, moved ? of.table.texels : 0);
    if (moved && !share) r.refuse("texels move by a share of each");
    if (squares && !moved) r.refuse("squares are summed where texels move");
    if (squares && Layout::kHasIds) r.refuse("squares are summed on CUDA");
  }
};

}  // namespace bt
