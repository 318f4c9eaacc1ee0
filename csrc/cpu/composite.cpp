// Weighted sums of the fragments per pixel, and their backward pass.
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
template <bool kMaps, class S>
void composite_forward(int64_t pixels, const S* geom, const int64_t* tile_start, int64_t tiles,
                       const FragmentArrays<S>& f, const S* colors, S* image) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  std::fill(image, image + pixels * channels, S(0));
  parallel_tiles(tile_start, tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t i = tile_start[first]; i < tile_start[last]; ++i) {
      const S* g = geom + int64_t(f.surfel[i]) * kGeom;
      S* to = image + int64_t(f.pixel[i]) * channels;
      add_blended<kMaps>(f.weight[i], colors + 3 * i, g[kBeta], f.depth[i], g + kNx, to);
    }
  });
}

template <bool kMaps, class S>
void composite_backward(int64_t n, const S* geom, const int64_t* tile_start, int64_t tiles, const FragmentArrays<S>& f,
                        const S* colors, const S* dimage, S* dweight, S* dcolors, S* ddepth, S* dgeom) {
  constexpr int channels = kMaps ? kMapChannels : kImageChannels;
  constexpr int kSums = 4;  // beta and the normal, per surfel
  std::vector<std::vector<S>> partial(std::max(num_threads(), 1));
  const int parts = parallel_tiles(tile_start, tiles, 64, [&](int part, int64_t first, int64_t last) {
    std::vector<S>& sums = partial[part];
    sums.assign(n * kSums, S(0));
    for (int64_t i = tile_start[first]; i < tile_start[last]; ++i) {
      const S w = f.weight[i];
      const S* g = geom + int64_t(f.surfel[i]) * kGeom;
      const S* d = dimage + int64_t(f.pixel[i]) * channels;
      S* to = sums.data() + int64_t(f.surfel[i]) * kSums;
      dweight[i] = weight_gradient<kMaps>(d, colors + 3 * i, g[kBeta], f.depth[i], g + kNx);
      dcolors[3 * i] = w * d[0], dcolors[3 * i + 1] = w * d[1], dcolors[3 * i + 2] = w * d[2];
      to[0] += w * d[4];
      if (kMaps) {
        ddepth[i] = w * d[5];
        to[1] += w * d[6], to[2] += w * d[7], to[3] += w * d[8];
      }
    }
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    std::fill(dgeom + begin * kGeom, dgeom + end * kGeom, S(0));
    for (int p = 0; p < parts; ++p)
      for (int64_t i = begin; i < end; ++i)
        for (int k = 0; k < kSums; ++k) dgeom[i * kGeom + kBeta + k] += partial[p][i * kSums + k];
  });
}

}  // namespace

template <class S>
void composite_forward(int64_t pixels, bool maps, const S* geom, const int64_t* tile_start, int64_t tiles,
                       const FragmentArrays<S>& f, const S* colors, S* image) {
  const auto run = maps ? composite_forward<true, S> : composite_forward<false, S>;
  run(pixels, geom, tile_start, tiles, f, colors, image);
}
template <class S>
void composite_backward(int64_t n, bool maps, const S* geom, const int64_t* tile_start, int64_t tiles,
                        const FragmentArrays<S>& f, const S* colors, const S* dimage, S* dweight, S* dcolors, S* ddepth,
                        S* dgeom) {
  const auto run = maps ? composite_backward<true, S> : composite_backward<false, S>;
  run(n, geom, tile_start, tiles, f, colors, dimage, dweight, dcolors, ddepth, dgeom);
}

#define BT_INSTANTIATE(S)                                                                                         \
  template void composite_forward<S>(int64_t, bool, const S*, const int64_t*, int64_t, const FragmentArrays<S>&,  \
                                     const S*, S*);                                                               \
  template void composite_backward<S>(int64_t, bool, const S*, const int64_t*, int64_t, const FragmentArrays<S>&, \
                                      const S*, const S*, S*, S*, S*, S*);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
