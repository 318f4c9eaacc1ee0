// The CUDA kernels as functions of an operation's arguments (csrc/ops), all on the device, and a stream. They do not
// allocate, wait for the device or depend on Python; the caller provides all memory.
#pragma once

#include <string>

#include "cuda/device.h"
#include "cuda/fragment_list.h"
#include "ops/appearance.h"
#include "ops/blend.h"
#include "ops/field.h"

// Instantiates a kernel, which takes Arguments<S>, for both number types.
#define BT_INSTANTIATE(kernel, Arguments)                \
  template void kernel(const Arguments<float>&, Stream); \
  template void kernel(const Arguments<double>&, Stream);

namespace bt::cuda {

// Explains why the kernels cannot run on CUDA device number `device`, with the remedy; empty if they can. Runs nothing.
std::string device_problem(int device);

template <class S> void project_forward(const ProjectForward<S>& a, Stream stream);
template <class S> void project_backward(const ProjectBackward<S>& a, Stream stream);

// Visibility without waiting. If a count decides an allocation, the caller reads the last entry of slot_start or
// offsets, allocates, and calls the next function.

// Sorts the surfels front to back and counts their tiles: writes order [n] and slot_start [n + 1]; slot_start[n] is the
// number of pairs.
template <class S> struct BinCount {
  View<S> view;
  int32_t* order;
  int64_t* slot_start;
  Workspace workspace;

  template <class R> void fields(R& r) {
    view.fields(r);
    r.array("order", order, view.n);
    r.array("slot_start", slot_start, view.n + 1);
    r.memory("workspace", workspace);
  }
};
template <class S> int64_t bin_count_workspace(int64_t n);
template <class S> void bin_count(const BinCount<S>& a, Stream stream);

// Lists the pairs (below 2^31): writes slot [pairs], surfel [pairs] and tile_pairs [tiles + 1]. Counted pairs that are
// not found come after those of the tiles.
template <class S> struct BinFill {
  View<S> view;
  const int32_t* order;
  const int64_t* slot_start;
  int64_t pairs;
  int32_t *slot, *surfel;
  int64_t* tile_pairs;
  Workspace workspace;

  template <class R> void fields(R& r) {
    view.fields(r);
    r.array("order", order, view.n);
    r.array("slot_start", slot_start, view.n + 1);
    r.rows("slot", slot, pairs, 1);
    check_pairs(r, pairs);
    r.array("surfel", surfel, pairs);
    r.array("tile_pairs", tile_pairs, tiles_of(view.width, view.height) + 1);
    r.memory("workspace", workspace);
  }
};
int64_t bin_fill_workspace(int64_t pairs, int width, int height);
template <class S> void bin_fill(const BinFill<S>& a, Stream stream);

// A view with its pairs in list order, and the pixels that blend each: masks [kTileWarps, pairs] are written.
template <class S> struct MarkedView {
  View<S> view;
  AlphaTiles<S> alpha;
  int64_t pairs;
  const int32_t* surfel;
  const int64_t* tile_pairs;
  uint32_t *masks, *cuts;  // cuts [kTileWarps, pairs]: where alpha texels multiply sigma; may be null

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    r.rows("surfel", surfel, pairs, 1);
    check_pairs(r, pairs);
    r.array("tile_pairs", tile_pairs, tiles_of(view.width, view.height) + 1);
    r.array("masks", masks, kTileWarps * pairs);
    r.maybe("cuts", cuts, kTileWarps * pairs);
  }
};

// Finds which pixels blend which pairs, and writes offsets [pairs + 1]; offsets[pairs] is the number of fragments.
template <class S> struct TraceMark : MarkedView<S> {
  int64_t* offsets;
  Workspace workspace;

  template <class R> void fields(R& r) {
    MarkedView<S>::fields(r);
    r.array("offsets", offsets, this->pairs + 1);
    r.memory("workspace", workspace);
  }
};
int64_t trace_mark_workspace(int64_t pairs);
template <class S> void trace_mark(const TraceMark<S>& a, Stream stream);

// Writes the fragments.
template <class S> struct TraceFill {
  View<S> view;
  AlphaTiles<S> alpha;
  Fragments<S, Pairs> fragments;

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    fragments.fields(r, view.n, view.width, view.height);
  }
};
template <class S> void trace_fill(const TraceFill<S>& a, Stream stream);

template <class S> void trace_backward(const TraceBackward<S, Pairs>& a, Stream stream);
template <class S> void blend_forward(const BlendForward<S, Pairs>& a, Stream stream);
template <class S> void blend_backward(const BlendBackward<S, Pairs>& a, Stream stream);
void masked_counts(const MaskedCounts<Pairs>& a, Stream stream);
// Selects the fragments with keep [F] not 0. Writes masks, and the number of fragments of each pair.
struct SelectPairs {
  Pairs layout;
  const uint8_t* keep;
  uint32_t* masks;
  int64_t* counts;

  template <class R> void fields(R& r) {
    take(r, "layout", layout);
    r.array("keep", keep, layout.fragments);
    r.array("masks", masks, kTileWarps * layout.pairs);
    r.array("counts", counts, layout.pairs);
  }
};
void select_fragments(const SelectPairs& a, Stream stream);

// Draws a view without a fragment list: `trace` and `blend` in one, opaque or with alpha texels. Writes image
// [height, width, kImageChannels or, with maps, kMapChannels] as BlendForward, and for the backward pass masks, cuts
// and each pixel's transmittance [height, width].
template <class S> struct RasterizeForward : MarkedView<S> {
  TexelTiles<S> table;
  S bound;
  int maps;
  S *image, *transmittance;

  template <class R> void fields(R& r) {
    MarkedView<S>::fields(r);
    table.fields(r);
    check_tiles(r, table, this->alpha, this->view.n);
    r.numbers("bound", bound, "maps", maps);
    const int64_t pixels = int64_t(this->view.width) * this->view.height;
    r.array("image", image, pixels * channels_of(maps));
    r.array("transmittance", transmittance, pixels);
  }
};
template <class S> void rasterize_forward(const RasterizeForward<S>& a, Stream stream);

// The step of texels and the gradients of their alphas, as BlendBackward and TraceBackward have them. sums [texels, 4]:
// working memory, if texels move or their alphas have gradients.
template <class S> struct TexelStep {
  const S* share;
  S rate;
  S *moved, *sums, *dalpha;

  template <class R> void fields(R& r, int64_t texels, bool alpha) {
    r.maybe("share", share, texels);
    r.number("rate", rate);
    r.maybe("moved", moved, 3 * texels);
    r.maybe("dtexel_alpha", dalpha, alpha ? texels : 0);
    r.maybe("texel_work", sums, 4 * texels);
    if (moved && !share) r.refuse("texels move by a share of each");
    if ((moved || dalpha) && !sums) r.refuse("gradients of texels need working memory");
  }
};

// Gradients as of TraceBackward and BlendBackward, except those of fragments. moves: texel coordinates pass gradients
// to surfels.
template <class S> struct RasterizeBackward {
  View<S> view;
  S rim;
  AlphaTiles<S> alpha;
  TexelTiles<S> table;
  S bound;
  Pairs layout;
  const uint32_t* cuts;
  const S *transmittance, *dimage;
  int moves, maps;
  S *partial, *color_partial, *dgeom, *absgrad, *dbase;
  TexelStep<S> step;

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    table.fields(r);
    check_tiles(r, table, alpha, view.n);
    r.numbers("rim", rim, "bound", bound, "moves", moves, "maps", maps);
    take(r, "layout", layout);
    if (!layout.fits(view.n, view.width, view.height)) r.refuse("the layout belongs to another view");
    r.maybe("cuts", cuts, kTileWarps * layout.pairs);
    if (alpha.values && !cuts) r.refuse("alpha texels need cuts");
    const int64_t pixels = int64_t(view.width) * view.height;
    r.array("transmittance", transmittance, pixels);
    r.array("dimage", dimage, pixels * channels_of(maps));
    r.work("partial", partial, layout.pairs * kTraceSums);
    r.work("color_partial", color_partial, layout.pairs * blend_sums(maps));
    r.array("dgeom", dgeom, view.n * kGeom);
    r.array("absgrad", absgrad, view.n * 2);
    r.array("dbase", dbase, view.n * 3);
    step.fields(r, table.texels, alpha.values);
  }
};
template <class S> void rasterize_backward(const RasterizeBackward<S>& a, Stream stream);

template <class S> void view_color_forward(const ViewColorForward<S>& a, Stream stream);
template <class S> void view_color_backward(const ViewColorBackward<S>& a, Stream stream);

template <class S> int64_t ssim_workspace(int height, int width, int channels, bool gradient);
template <class S> void ssim(const Ssim<S>& a, Stream stream);

template <class S> void learn_exposure(const LearnExposure<S>& a, Stream stream);

template <class S> void field_forward(const FieldForward<S>& a, Stream stream);
template <class S> void field_backward(const FieldBackward<S>& a, Stream stream);

}  // namespace bt::cuda
