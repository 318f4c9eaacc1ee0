// Arguments of projection and tracing.
#pragma once

#include "ops/texel.h"

namespace bt {

// viewmat [4, 4] and K [3, 3] are on the surfels' device. Writes geom [n, kGeom], frames [n, kFrame] and radii [n, 2]
// (half extents of the level-set box in pixels); rows of invisible surfels are zero. Adds the number of rows that are
// not finite to broken [1]. `photo_pixel` must be the same wherever the rows are used; other than 1 it is for the baked
// renderer only.
template <class S> struct ProjectForward {
  Surfels<S> surfels;
  const S *viewmat, *K;
  int width, height;
  S near;
  S photo_pixel;  // side of a photograph's pixel in pixels of the view
  S *geom, *frames, *radii;
  int32_t* broken;

  template <class R> void fields(R& r) {
    surfels.fields(r);
    r.array("viewmat", viewmat, 16);
    r.array("K", K, 9);
    r.numbers("width", width, "height", height, "near", near);
    r.number("photo_pixel", photo_pixel);
    r.array("geom", geom, surfels.n * kGeom);
    r.array("frames", frames, surfels.n * kFrame);
    r.array("radii", radii, surfels.n * 2);
    r.array("broken", broken, 1);
  }
};

// dframes may be null (zero). Writes the surfels' gradients.
template <class S> struct ProjectBackward {
  Surfels<S> surfels;
  const S *viewmat, *K;
  const S *geom, *dgeom, *dframes;
  SurfelGradients<S> out;

  template <class R> void fields(R& r) {
    surfels.fields(r);
    r.array("viewmat", viewmat, 16);
    r.array("K", K, 9);
    r.arrays(surfels.n * kGeom, "geom", geom, "dgeom", dgeom);
    r.maybe("dframes", dframes, surfels.n * kFrame);
    out.fields(r, surfels.n);
  }
};

template <class S> struct View {
  int64_t n;
  const S *geom, *radii;
  int width, height;
  S near;
  S photo_pixel;

  template <class R> void fields(R& r) {
    r.rows("radii", radii, n, 2);
    r.wide("geom", geom, n * kGeom);
    r.numbers("width", width, "height", height, "near", near);
    r.number("photo_pixel", photo_pixel);
  }
};

// Writes dgeom [n, kGeom] and absgrad [n, 2]. dweight, duv, ddepth may be null (zero); rim as in fragment_vjp
// (core/kernel.h). dsigma and partial are working memory: a row of partial has the sums of a pair (a surfel in a screen
// tile), gradients of columns 0 to kBeta of geom, two absolute gradients, and two unused.
constexpr int kTraceSums = 16;
template <class S, class Layout> struct TraceBackward {
  View<S> view;
  S rim;
  Fragments<S, Layout> fragments;
  const S *dweight, *duv, *ddepth;
  S *dsigma, *partial;
  S *dgeom, *absgrad;
  AlphaTiles<S> alpha;
  S* dtexel_alpha;       // [texels] written, unless null
  int64_t* exact_alpha;  // order-independent sums of it on CUDA, working memory; or null

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    const int64_t texels = alpha.values ? alpha.texels : 0;
    r.maybe("dtexel_alpha", dtexel_alpha, texels);
    r.maybe("exact_work", exact_alpha, exact_size(texels));
    r.number("rim", rim);
    fragments.fields(r, view.n, view.width, view.height);
    const int64_t total = fragments.f.total;
    r.maybe("dweight", dweight, total);
    r.maybe("duv", duv, 2 * total);
    r.maybe("ddepth", ddepth, total);
    r.work("dsigma", dsigma, total);
    r.work("partial", partial, fragments.layout.pairs * kTraceSums);
    r.array("dgeom", dgeom, view.n * kGeom);
    r.array("absgrad", absgrad, view.n * 2);
  }
};

// Adds to counts [n] the fragments of each surfel on pixels with mask [height, width] not 0.
template <class Layout> struct MaskedCounts {
  Layout layout;
  int width, height;
  int64_t n;
  const uint8_t* mask;
  int32_t* counts;

  template <class R> void fields(R& r) {
    take(r, "layout", layout);
    r.numbers("width", width, "height", height);
    r.array("mask", mask, int64_t(width) * height);
    r.rows("counts", counts, n, 1);
    if (!layout.fits(n, width, height)) r.refuse("the layout is not that of such a view");
  }
};

}  // namespace bt
