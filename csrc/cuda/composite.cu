// Weighted sums of the fragments per pixel, and their backward pass. Both are bound by memory: 16 bytes per fragment
// are read forward (20 with maps), about 36 read and written backward.
#include "cuda/kernels.h"

namespace bt::cuda {

namespace {
template <class S> struct BlendInput {
  S weight, color[3], beta;
  S depth, normal[3];  // with maps
};

template <class S, bool kMaps>
__global__ void __launch_bounds__(kTileThreads)
    forward_kernel(const S* geom, Pairs p, FragmentArrays<S> f, const S* colors, S* image) {
  constexpr int kChannels = kMaps ? kMapChannels : kImageChannels;
  const TileThread s = tile_thread(p.width);
  S sum[kChannels];
  for (int c = 0; c < kChannels; ++c) sum[c] = S(0);
  const auto load = [&](int64_t, int32_t id, bool mine, int64_t i) {
    BlendInput<S> t = {};
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
  const auto use = [&](const BlendInput<S>& t) {
    add_blended<kMaps>(t.weight, t.color, t.beta, t.depth, t.normal, sum);
  };
  for_each_fragment<4, false>(p, s, load, use);
  if (s.x >= p.width || s.y >= p.height) return;
  S* to = image + (int64_t(s.y) * p.width + s.x) * kChannels;
  for (int c = 0; c < kChannels; ++c) to[c] = sum[c];
}

// One block per tile, so that the tile's part of dimage is read once, into shared memory, and kRunLanes lanes per pair.
// A run is read and written from a multiple of 8 fragments on, and dcolors goes through shared memory: memory takes
// whole sectors of 32 bytes faster than parts.
template <class S, bool kMaps>
__global__ void __launch_bounds__(kTileThreads, sizeof(S) == 4 && !kMaps ? 6 : 1)
    backward_kernel(const S* geom, Pairs p, FragmentArrays<S> f, const S* colors, const S* dimage, S* partial,
                    S* dweight, S* dcolors, S* ddepth) {
  constexpr int kChannels = kMaps ? kMapChannels : kImageChannels, kSums = kMaps ? 4 : 1;
  constexpr int kWorkers = kTileThreads / kRunLanes, kWhole = 8;
  __shared__ S gradient[kTileThreads * kChannels];
  __shared__ S out[kWorkers][3 * kRunLanes];
  const auto [first, end] = block_pairs(p);
  if (first == end) return;
  const TilePart tile(p);
  tile.load<kChannels>(dimage, gradient);
  __syncthreads();
  const int lane = int(threadIdx.x) % kRunLanes, worker = int(threadIdx.x) / kRunLanes;
  S* const put = out[worker];
  // The runs of a warp take their turns together.
  for (int64_t k = first + worker; k - worker % 2 < end; k += kWorkers) {
    const bool some = k < end;
    const int64_t begin = some ? p.offsets[k] : 0;
    const int skipped = int(begin % kWhole), count = some ? int(p.offsets[k + 1] - begin) : 0;
    const S* g = geom + int64_t(some ? p.surfel[k] : 0) * kGeom;
    const S beta = g[kBeta], normal[3] = {g[kNx], g[kNy], g[kNz]};
    S* const run_colors = dcolors + 3 * begin;
    S sums[kSums];  // beta and the normal
    BT_UNROLL
    for (int c = 0; c < kSums; ++c) sums[c] = S(0);
    const int own = count ? skipped + count : 0, stop = max_(own, __shfl_xor_sync(kFullMask, own, kRunLanes));
    for (int turn = 0; turn < stop; turn += kRunLanes) {
      const int at = turn - skipped;  // of the turn's first fragment in the run
      const int64_t i = begin + at + lane;
      const bool mine = at + lane >= 0 && at + lane < count;
      S w = S(0), color[3] = {S(0), S(0), S(0)}, depth = S(0);
      int pixel = 0;
      if (mine) {
        pixel = f.pixel[i], w = f.weight[i];
        BT_UNROLL
        for (int c = 0; c < 3; ++c) color[c] = colors[3 * i + c];
        if (kMaps) depth = f.depth[i];
      }
      __syncwarp();  // no load is put off until its number is used: one wait is for all
      if (mine) {
        const S* d = gradient + tile.at(pixel) * kChannels;
        dweight[i] = weight_gradient<kMaps>(d, color, beta, depth, normal);
        BT_UNROLL
        for (int c = 0; c < 3; ++c) put[3 * lane + c] = w * d[c];
        sums[0] += w * d[4];
        if (kMaps) {
          const S* m = d + kChannels - 4;
          ddepth[i] = w * m[0];
          BT_UNROLL
          for (int c = 1; c < kSums; ++c) sums[c] += w * m[c];
        }
      }
      __syncwarp();
      BT_UNROLL
      for (int c = 0; c < 3; ++c) {
        const int j = c * kRunLanes + lane, to = 3 * at + j;
        if (to >= 0 && to < 3 * count) run_colors[to] = put[j];
      }
      __syncwarp();
    }
    const S sum = sum_over_run(sums, lane);
    if (some && lane < kSums) partial[int64_t(p.slot[k]) * kSums + lane] = sum;
  }
}

// Columns beta and normal of a row that is 0 elsewhere.
template <class S> struct StoreGeomGradient {
  S* dgeom;
  __device__ void operator()(int64_t surfel, int column, S sum) const { dgeom[surfel * kGeom + kBeta + column] = sum; }
};

template <class S, bool kMaps> void backward(const CompositeBackward<S, Pairs>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  if (p.pairs)
    BT_LAUNCH((backward_kernel<S, kMaps>), dim3(unsigned(p.tiles())), dim3(kTileThreads), 0, stream, a.geom, p,
              a.fragments.f, a.colors, a.dimage, a.partial, a.dweight, a.dcolors, a.ddepth);
  fill_zero(a.dgeom, p.surfels * kGeom, stream);
  sum_slots<kMaps ? 4 : 1>(p, static_cast<const S*>(a.partial), StoreGeomGradient<S>{a.dgeom}, stream);
}
}  // namespace

template <class S> void composite_forward(const CompositeForward<S, Pairs>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  const FragmentArrays<S>& f = a.fragments.f;
  const dim3 tiles(unsigned(p.tiles())), threads(kTileThreads);
  if (a.maps)
    BT_LAUNCH((forward_kernel<S, true>), tiles, threads, 0, stream, a.geom, p, f, a.colors, a.image);
  else
    BT_LAUNCH((forward_kernel<S, false>), tiles, threads, 0, stream, a.geom, p, f, a.colors, a.image);
}
template <class S> void composite_backward(const CompositeBackward<S, Pairs>& a, Stream stream) {
  a.maps ? backward<S, true>(a, stream) : backward<S, false>(a, stream);
}

#define BT_INSTANTIATE(S)                                                     \
  template void composite_forward(const CompositeForward<S, Pairs>&, Stream); \
  template void composite_backward(const CompositeBackward<S, Pairs>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
