// A training view without fragment lists: projection, view colours, visibility, image and losses, and their gradients.
// Three calls enqueue some thirty kernels, for which Python would need milliseconds; the host waits once, for the
// number of pairs. Every kernel is that of the operation of the same name (kernels.h, training.h).
#pragma once

#include "cuda/kernels.h"
#include "cuda/training.h"

namespace bt::cuda {

// Inputs, and what the forward calls write: geom, frames, radii and broken as of ProjectForward, and both losses.
// Without texels, tiles are of 0 x 0. `memory` holds the rest until the backward call.
template <class S> struct TrainingView {
  Surfels<S> surfels;
  const S *viewmat, *K;
  const double* center;  // [3] of the camera, world
  int width, height;
  S near, rim, bound;
  ViewColorArrays<const S> colors;
  TexelTiles<S> table;  // base is set by the calls
  AlphaTiles<S> alpha;
  int moves;           // texel coordinates pass gradients to surfels
  Picture<S> picture;  // its image is set by the calls
  S *geom, *frames, *radii;
  int32_t* broken;
  S *photometric, *falloff;
  Workspace memory;

  template <class R> void fields(R& r) {
    surfels.fields(r);
    r.array("viewmat", viewmat, 16);
    r.array("K", K, 9);
    r.array("center", center, 3);
    r.numbers("width", width, "height", height, "near", near, "rim", rim, "bound", bound, "moves", moves);
    colors.fields(r, surfels.n);
    table.tiles(r);
    alpha.fields(r, surfels.n);
    check_tiles(r, table, alpha, surfels.n);
    picture.width = width, picture.height = height;
    picture.compared(r);
    r.wide("geom", geom, surfels.n * kGeom);
    r.array("frames", frames, surfels.n * kFrame);
    r.array("radii", radii, surfels.n * 2);
    r.array("broken", broken, 1);
    r.arrays(1, "photometric", photometric, "falloff", falloff);
    r.memory("memory", memory);
  }
};
template <class S> int64_t training_view_workspace(int64_t n, int width, int height);
int64_t training_pairs_workspace(int64_t pairs, int width, int height, bool alpha, bool wide);

// Projects the surfels, evaluates their colours and counts the pairs; waits for their number and returns it.
template <class S> int64_t count_view(const TrainingView<S>& a, Stream stream);

template <class S> struct DrawView {
  const TrainingView<S>* view;
  int64_t pairs;          // from count_view
  Workspace pair_memory;  // kept until the backward call

  template <class R> void fields(R& r) {
    r.object("view", view);
    r.number("pairs", pairs);
    check_pairs(r, pairs);
    r.memory("pair_memory", pair_memory);
  }
};
// Draws the view and computes the losses.
template <class S> void draw_view(const DrawView<S>& a, Stream stream);

// Writes the gradients of both losses with respect to the surfels: `out` through the projection, dmeans_color [n, 3]
// through the direction of the view colours, and dcolors; dgeom [n, kGeom] and absgrad [n, 2]; dcorrection unless null.
template <class S> struct DifferentiateView {
  DrawView<S> drawn;
  const S *dphotometric, *dfalloff;
  TexelStep<S> step;
  S *dcorrection, *dgeom, *absgrad, *dmeans_color;
  SurfelGradients<S> out;
  ViewColorArrays<S> dcolors;

  template <class R> void fields(R& r) {
    drawn.fields(r);
    const TrainingView<S>& v = *drawn.view;
    const int64_t n = v.surfels.n;
    r.arrays(1, "dphotometric", dphotometric, "dfalloff", dfalloff);
    step.fields(r, v.table.texels, v.alpha.values);
    r.maybe("dcorrection", dcorrection, v.picture.corrected);
    r.array("dgeom", dgeom, n * kGeom);
    r.array("absgrad", absgrad, n * 2);
    r.array("dmeans_color", dmeans_color, n * 3);
    out.fields(r, n);
    dcolors.kind = v.colors.kind, dcolors.terms = v.colors.terms;
    dcolors.arrays(r, n, "da", "db", "dc");
  }
};
template <class S> void differentiate_view(const DifferentiateView<S>& a, Stream stream);

}  // namespace bt::cuda
