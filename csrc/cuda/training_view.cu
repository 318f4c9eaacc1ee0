// The calls of training_view.h.
#include "cuda/training_view.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 256;

// Arrays that last from the first call of a view to the last.
template <class S> struct ViewSpace {
  S *base, *dbase;                    // [n, 3]
  uint8_t* active;                    // [n]
  int32_t* order;                     // [n]
  int64_t* slot_start;                // [n + 1]
  S *image, *dimage, *transmittance;  // [pixels, kImageChannels], [pixels]
  Workspace count, picture;
  ViewSpace(Arena& arena, int64_t n, int width, int height) {
    const int64_t pixels = int64_t(width) * height;
    base = arena.take<S>(3 * n), dbase = arena.take<S>(3 * n);
    active = arena.take<uint8_t>(n), order = arena.take<int32_t>(n), slot_start = arena.take<int64_t>(n + 1);
    image = arena.take<S>(kImageChannels * pixels), dimage = arena.take<S>(kImageChannels * pixels);
    transmittance = arena.take<S>(pixels);
    count.bytes = bin_count_workspace<S>(n), count.at = arena.take<char>(count.bytes);
    picture.bytes = picture_workspace<S>(height, width), picture.at = arena.take<char>(picture.bytes);
  }
};
template <class S> struct PairSpace {
  int32_t *slot, *surfel;      // [pairs]
  int64_t* tile_pairs;         // [tiles + 1]
  uint32_t *masks, *cuts;      // [kTileWarps, pairs]; cuts is null without alpha texels
  S *partial, *color_partial;  // [pairs, kTraceSums], [pairs, 4]
  Workspace fill;
  PairSpace(Arena& arena, int64_t pairs, int width, int height, bool alpha) {
    slot = arena.take<int32_t>(pairs), surfel = arena.take<int32_t>(pairs);
    tile_pairs = arena.take<int64_t>(tiles_of(width, height) + 1);
    masks = arena.take<uint32_t>(kTileWarps * pairs);
    cuts = alpha ? arena.take<uint32_t>(kTileWarps * pairs) : nullptr;
    fill.bytes = bin_fill_workspace(pairs, width, height);
    partial = arena.take<S>(max_(kTraceSums * pairs, ceil_div(fill.bytes, int64_t(sizeof(S)))));
    fill.at = partial;  // lists are sorted before sums are written
    color_partial = arena.take<S>(4 * pairs);
  }
};

// A view with its arrays.
template <class S> struct Spaces {
  TrainingView<S> v;
  ViewSpace<S> of;

  explicit Spaces(const TrainingView<S>& view)
      : v(view), of(cut_space<ViewSpace<S>>(view.memory, view.surfels.n, view.width, view.height)) {
    v.table.base = of.base, v.picture.image = of.image, v.picture.workspace = of.picture;
  }
  PairSpace<S> pairs(const DrawView<S>& drawn) const {
    return cut_space<PairSpace<S>>(drawn.pair_memory, drawn.pairs, v.width, v.height, v.alpha.values != nullptr);
  }
  View<S> view() const { return {v.surfels.n, v.geom, v.radii, v.width, v.height, v.near, S(1)}; }
  Directions<S> directions() const { return {v.surfels.n, v.surfels.means, v.center, of.active}; }
};

template <class S>
__global__ void __launch_bounds__(kThreads) active_kernel(int64_t n, const S* radii, uint8_t* active) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) active[i] = radii[2 * i] > S(0);
}

// Reads one number from the device, after all that is enqueued.
int64_t read_number(const int64_t* at, Stream stream) {
#if defined(__CUDACC__)
  int64_t value;
  check(cudaMemcpyAsync(&value, at, sizeof value, cudaMemcpyDeviceToHost, static_cast<cudaStream_t>(stream)), "read");
  check(cudaStreamSynchronize(static_cast<cudaStream_t>(stream)), "wait for the number of pairs");
  return value;
#else
  (void)stream;
  return *at;
#endif
}
}  // namespace

template <class S> int64_t training_view_workspace(int64_t n, int width, int height) {
  return space_bytes<ViewSpace<S>>(n, width, height);
}
int64_t training_pairs_workspace(int64_t pairs, int width, int height, bool alpha, bool wide) {
  return wide ? space_bytes<PairSpace<double>>(pairs, width, height, alpha)
              : space_bytes<PairSpace<float>>(pairs, width, height, alpha);
}

template <class S> int64_t count_view(const TrainingView<S>& a, Stream stream) {
  const Spaces<S> s(a);
  const int64_t n = a.surfels.n;
  fill_zero(a.broken, 1, stream);
  project_forward(ProjectForward<S>{a.surfels, a.viewmat, a.K, a.width, a.height, a.near, S(1), a.geom, a.frames,
                                    a.radii, a.broken},
                  stream);
  BT_LAUNCH_EACH(active_kernel<S>, n, kThreads, stream, n, a.radii, s.of.active);
  ViewColorForward<S> colors = {};
  colors.to = s.directions(), colors.colors.whole = a.colors, colors.out = s.of.base;
  view_color_forward(colors, stream);
  bin_count(BinCount<S>{s.view(), s.of.order, s.of.slot_start, s.of.count}, stream);
  return read_number(s.of.slot_start + n, stream);
}

template <class S> void draw_view(const DrawView<S>& a, Stream stream) {
  const Spaces<S> s(*a.view);
  const PairSpace<S> p = s.pairs(a);
  bin_fill(BinFill<S>{s.view(), s.of.order, s.of.slot_start, a.pairs, p.slot, p.surfel, p.tile_pairs, p.fill}, stream);
  const MarkedView<S> marked = {s.view(), s.v.alpha, a.pairs, p.surfel, p.tile_pairs, p.masks, p.cuts};
  rasterize_forward(RasterizeForward<S>{marked, s.v.table, s.v.bound, 0, s.of.image, s.of.transmittance}, stream);
  picture_loss(s.v.picture, s.v.photometric, s.v.falloff, stream);
}

template <class S> void differentiate_view(const DifferentiateView<S>& a, Stream stream) {
  const Spaces<S> s(*a.drawn.view);
  const PairSpace<S> p = s.pairs(a.drawn);
  const TrainingView<S>& v = s.v;
  picture_loss_backward(v.picture, a.dphotometric, a.dfalloff, s.of.dimage, a.dcorrection, stream);
  const Pairs layout = {v.width, v.height, v.surfels.n,  a.drawn.pairs, p.surfel,        p.slot,
                        p.masks, nullptr,  p.tile_pairs, s.of.order,    s.of.slot_start, -1};
  const RasterizeBackward<S> gradients = {
      s.view(),           v.rim,       v.alpha, v.table, v.bound,   layout,          p.cuts,
      s.of.transmittance, s.of.dimage, v.moves, 0,       p.partial, p.color_partial, a.dgeom,
      a.absgrad,          s.of.dbase,  a.step};
  rasterize_backward(gradients, stream);
  view_color_backward(ViewColorBackward<S>{s.directions(), v.colors, s.of.dbase, a.dcolors, a.dmeans_color}, stream);
  project_backward(ProjectBackward<S>{v.surfels, v.viewmat, v.K, v.geom, a.dgeom, nullptr, a.out}, stream);
}

template int64_t training_view_workspace<float>(int64_t, int, int);
template int64_t training_view_workspace<double>(int64_t, int, int);
template int64_t count_view(const TrainingView<float>&, Stream);
template int64_t count_view(const TrainingView<double>&, Stream);
BT_INSTANTIATE(draw_view, DrawView)
BT_INSTANTIATE(differentiate_view, DifferentiateView)

}  // namespace bt::cuda
