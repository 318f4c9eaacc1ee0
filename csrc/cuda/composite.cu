// Weighted sums of the fragments per pixel, and their backward pass. Both are bound by memory: 16 bytes per fragment
// are read forward (20 with maps), about 36 read and written backward.
#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
template <class S>
struct Taken {
  S weight, color[3], beta;
  S depth, normal[3];  // with maps
};

template <class S, bool kMaps>
__global__ void __launch_bounds__(kTileThreads)
    forward_kernel(const S* geom, Pairs p, FragmentArrays<S> f, const S* colors, S* image) {
  constexpr int kChannels = kMaps ? kMapChannels : kImageChannels;
  const Spot s = spot(p.width);
  S sum[kChannels];
  for (int c = 0; c < kChannels; ++c) sum[c] = S(0);
  const auto load = [&](int64_t, int32_t id, bool mine, int64_t i) {
    Taken<S> t = {};
    if (!mine) return t;
    const S* g = geom + int64_t(id) * kGeom;
    t.weight = f.weight[i], t.beta = g[kBeta];
    for (int c = 0; c < 3; ++c) t.color[c] = colors[3 * i + c];
    if (kMaps) {
      t.depth = f.depth[i];
      for (int c = 0; c < 3; ++c) t.normal[c] = g[kNx + c];
    }
    return t;
  };
  const auto use = [&](const Taken<S>& t) { add_blended<kMaps>(t.weight, t.color, t.beta, t.depth, t.normal, sum); };
  walk<4, false>(p, s, load, use);
  if (s.x >= p.width || s.y >= p.height) return;
  S* to = image + (int64_t(s.y) * p.width + s.x) * kChannels;
  for (int c = 0; c < kChannels; ++c) to[c] = sum[c];
}

template <class S, bool kMaps>
__global__ void __launch_bounds__(kRunThreads)
    backward_kernel(const S* geom, Pairs p, FragmentArrays<S> f, const S* colors, const S* dimage, S* partial,
                    S* dweight, S* dcolors, S* ddepth) {
  constexpr int kChannels = kMaps ? kMapChannels : kImageChannels, kSums = kMaps ? 4 : 1;
  const Run r = run(p);
  S sums[kSums];  // beta and the normal
  for (int c = 0; c < kSums; ++c) sums[c] = S(0);
  if (r.begin < r.end) {
    const S* g = geom + int64_t(p.surfel[r.k]) * kGeom;
    const S beta = g[kBeta], normal[3] = {g[kNx], g[kNy], g[kNz]};
    for (int64_t i = r.begin + r.lane; i < r.end; i += kRunLanes) {
      const S w = f.weight[i];
      const S* d = dimage + int64_t(f.pixel[i]) * kChannels;
      dweight[i] = weight_gradient<kMaps>(d, colors + 3 * i, beta, f.depth[i], normal);
      for (int k = 0; k < 3; ++k) dcolors[3 * i + k] = w * d[k];
      sums[0] += w * d[4];
      if (kMaps) {
        const S* m = d + kChannels - 4;
        ddepth[i] = w * m[0];
        for (int k = 1; k < kSums; ++k) sums[k] += w * m[k];
      }
    }
  }
  const S sum = sum_over_run(sums, r.lane);
  if (r.some && r.lane < kSums) partial[int64_t(p.slot[r.k]) * kSums + r.lane] = sum;
}

// Columns beta and normal of a row that is 0 elsewhere.
template <class S>
struct PutGeometry {
  S* dgeom;
  __device__ void operator()(int64_t surfel, int column, S sum) const { dgeom[surfel * kGeom + kBeta + column] = sum; }
};

template <class S, bool kMaps>
void backward(const CompositeBackward<S, Pairs>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  if (p.pairs)
    BT_LAUNCH((backward_kernel<S, kMaps>), run_blocks(p), dim3(kRunThreads), 0, stream, a.geom, p, a.fragments.f,
              a.colors, a.dimage, a.partial, a.dweight, a.dcolors, a.ddepth);
  fill_zero(a.dgeom, p.surfels * kGeom, stream);
  sum_slots<kMaps ? 4 : 1>(p, static_cast<const S*>(a.partial), PutGeometry<S>{a.dgeom}, stream);
}
}  // namespace

template <class S>
void composite_forward(const CompositeForward<S, Pairs>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  const dim3 tiles(unsigned(p.tiles())), threads(kTileThreads);
  if (a.maps)
    BT_LAUNCH((forward_kernel<S, true>), tiles, threads, 0, stream, a.geom, p, f, a.colors, a.image);
  else
    BT_LAUNCH((forward_kernel<S, false>), tiles, threads, 0, stream, a.geom, p, f, a.colors, a.image);
}
template <class S>
void composite_backward(const CompositeBackward<S, Pairs>& a, Stream stream) {
  a.maps ? backward<S, true>(a, stream) : backward<S, false>(a, stream);
}

#define BT_INSTANTIATE(S)                                                     \
  template void composite_forward(const CompositeForward<S, Pairs>&, Stream); \
  template void composite_backward(const CompositeBackward<S, Pairs>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
