// Weighted sums of the fragments per pixel, and their backward pass.
#include "cpu/blocks.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
template <bool kMaps, class S> void forward(const CompositeForward<S, TileBlocks>& a) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  const S *geom = a.geom, *colors = a.colors;
  const TileBlocks& layout = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  S* image = a.image;
  std::fill(image, image + a.pixels() * channels, S(0));
  parallel_tiles(layout.start, layout.tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t tile = first; tile < last; ++tile)
      each_fragment(layout, tile, a.width, [&](const BlockRun& run, int64_t i, int64_t pixel) {
        const S* g = geom + int64_t(run.surfel) * kGeom;
        add_blended<kMaps>(f.weight[i], colors + 3 * i, g[kBeta], f.depth[i], g + kNx, image + pixel * channels);
      });
  });
}

template <bool kMaps, class S> void backward(const CompositeBackward<S, TileBlocks>& a) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  const S *geom = a.geom, *colors = a.colors, *dimage = a.dimage;
  const int64_t n = a.n;
  const TileBlocks& layout = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  S *dweight = a.dweight, *dcolors = a.dcolors, *ddepth = a.ddepth, *dgeom = a.dgeom;
  constexpr int kSums = 4;  // beta and the normal, per surfel
  std::vector<std::vector<S>> partial(std::max(num_threads(), 1));
  const int parts = parallel_tiles(layout.start, layout.tiles, 64, [&](int part, int64_t first, int64_t last) {
    std::vector<S>& sums = partial[part];
    sums.assign(n * kSums, S(0));
    for (int64_t tile = first; tile < last; ++tile)
      each_fragment(layout, tile, a.width, [&](const BlockRun& run, int64_t i, int64_t pixel) {
        const S w = f.weight[i], *g = geom + int64_t(run.surfel) * kGeom, *d = dimage + pixel * channels;
        S* to = sums.data() + int64_t(run.surfel) * kSums;
        dweight[i] = weight_gradient<kMaps>(d, colors + 3 * i, g[kBeta], f.depth[i], g + kNx);
        dcolors[3 * i] = w * d[0], dcolors[3 * i + 1] = w * d[1], dcolors[3 * i + 2] = w * d[2];
        to[0] += w * d[4];
        if (kMaps) {
          ddepth[i] = w * d[5];
          to[1] += w * d[6], to[2] += w * d[7], to[3] += w * d[8];
        }
      });
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    std::fill(dgeom + begin * kGeom, dgeom + end * kGeom, S(0));
    for (int p = 0; p < parts; ++p)
      for (int64_t i = begin; i < end; ++i)
        for (int k = 0; k < kSums; ++k) dgeom[i * kGeom + kBeta + k] += partial[p][i * kSums + k];
  });
}

}  // namespace

template <class S> void composite_forward(const CompositeForward<S, TileBlocks>& a) {
  a.maps ? forward<true>(a) : forward<false>(a);
}
template <class S> void composite_backward(const CompositeBackward<S, TileBlocks>& a) {
  a.maps ? backward<true>(a) : backward<false>(a);
}

#define BT_INSTANTIATE(S)                                                  \
  template void composite_forward(const CompositeForward<S, TileBlocks>&); \
  template void composite_backward(const CompositeBackward<S, TileBlocks>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
