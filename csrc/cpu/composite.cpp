// Weighted sums of the fragments per pixel, and their backward pass.
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

template <class S>
void composite_forward(int64_t pixels, bool maps, const S* geom, const int64_t* tile_start, int64_t tiles,
                       const FragmentArrays<S>& f, const S* colors, S* image) {
  const int channels = maps ? kMapChannels : kImageChannels;
  std::fill(image, image + pixels * channels, S(0));
  parallel_tiles(tile_start, tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    for (int64_t i = tile_start[first]; i < tile_start[last]; ++i) {
      const S w = f.weight[i];
      const S* g = geom + int64_t(f.surfel[i]) * kGeom;
      S* to = image + int64_t(f.pixel[i]) * channels;
      to[0] += w * colors[3 * i], to[1] += w * colors[3 * i + 1], to[2] += w * colors[3 * i + 2];
      to[3] += w;
      to[4] += w * g[kBeta];
      if (maps) {
        to[5] += w * f.depth[i];
        to[6] += w * g[kNx], to[7] += w * g[kNy], to[8] += w * g[kNz];
      }
    }
  });
}

template <class S>
void composite_backward(int64_t n, bool maps, const S* geom, const int64_t* tile_start, int64_t tiles,
                        const FragmentArrays<S>& f, const S* colors, const S* dimage, S* dweight, S* dcolors, S* ddepth,
                        S* dgeom) {
  const int channels = maps ? kMapChannels : kImageChannels;
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
      S gw = d[0] * colors[3 * i] + d[1] * colors[3 * i + 1] + d[2] * colors[3 * i + 2] + d[3] + d[4] * g[kBeta];
      dcolors[3 * i] = w * d[0], dcolors[3 * i + 1] = w * d[1], dcolors[3 * i + 2] = w * d[2];
      to[0] += w * d[4];
      if (maps) {
        gw += d[5] * f.depth[i] + d[6] * g[kNx] + d[7] * g[kNy] + d[8] * g[kNz];
        ddepth[i] = w * d[5];
        to[1] += w * d[6], to[2] += w * d[7], to[3] += w * d[8];
      }
      dweight[i] = gw;
    }
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    std::fill(dgeom + begin * kGeom, dgeom + end * kGeom, S(0));
    for (int p = 0; p < parts; ++p)
      for (int64_t i = begin; i < end; ++i)
        for (int k = 0; k < kSums; ++k) dgeom[i * kGeom + kBeta + k] += partial[p][i * kSums + k];
  });
}

#define BT_INSTANTIATE(S)                                                                                         \
  template void composite_forward<S>(int64_t, bool, const S*, const int64_t*, int64_t, const FragmentArrays<S>&,  \
                                     const S*, S*);                                                               \
  template void composite_backward<S>(int64_t, bool, const S*, const int64_t*, int64_t, const FragmentArrays<S>&, \
                                      const S*, const S*, S*, S*, S*, S*);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
