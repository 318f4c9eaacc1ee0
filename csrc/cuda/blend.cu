// Shading and blending, and the backward pass; colours and their gradients stay on the multiprocessor.
//
// Forward, a block takes its tile's list chunk by chunk through shared memory: threads first compute colours, a
// fragment each, then each lane adds up those of its pixel. So all lanes are busy with texel fetches, and sums need no
// atomics.
//
// Backward, kRunLanes lanes take a pair's fragments in turn, with the tile's part of dimage in shared memory. A pair's
// contribution to its surfel goes to its slot, so only sums of texels depend on the order.
//
// Bytes per fragment: surfels alone; with texels, besides fetching four of 12 bytes each; with a residual per fragment:
//             alone   with texels   with residuals
//   forward     8         16              20
//   backward   12         24              36
#include "core/blend.h"
#include "cuda/kernels.h"
#include "cuda/texel_sums.h"

namespace bt::cuda {

namespace {
template <class S, bool kMaps>
__global__ void __launch_bounds__(kTileThreads, sizeof(S) == 8 ? 1
                                                : kMaps        ? 4
                                                               : 5)
    forward_kernel(BlendedSurfels<S, Pairs> of, S* __restrict__ image) {
  constexpr int kHeld = 4096 / sizeof(S), kChannels = channels_of(kMaps);
  __shared__ int bits[kTileWarps][kWarp];
  __shared__ S weights[kHeld], colors[3][kHeld], depths[kMaps ? kHeld : 1];
  const Pairs& p = of.fragments.layout;
  const FragmentArrays<S>& f = of.fragments.f;
  const TileThread s = tile_thread(p.width);
  const int64_t end = p.tile_pairs[blockIdx.x + 1];
  S sum[kChannels];
  for (int c = 0; c < kChannels; ++c) sum[c] = S(0);
  int taken_pairs = 0;
  for (int64_t first = p.tile_pairs[blockIdx.x]; first < end; first += taken_pairs) {
    Stretch<kHeld> part(p, s, first, end, bits);
    taken_pairs = part.pairs;
    if (!taken_pairs) break;
    // beta and normal, one lane per pair
    const bool some = s.lane < taken_pairs;
    const S* g = of.geom + (some ? int64_t(p.surfel[first + s.lane]) * kGeom : 0);
    const S beta = some ? g[kBeta] : S(0), nx = kMaps && some ? g[kNx] : S(0), ny = kMaps && some ? g[kNy] : S(0),
            nz = kMaps && some ? g[kNz] : S(0);
    __syncthreads();  // the previous chunk has been summed
    part.find_own(s);
    part.each_fragment([&](int i, int64_t at) {
      const bool textured = of.table.texels > 0;
      const int32_t id = f.surfel[at];
      const S w = f.weight[at], u = textured ? f.uv[at] : S(0), v = textured ? f.uv[f.total + at] : S(0);
      const TexelPatch<S> patch(of.table, id);
      Vec3<S> c = patch.color(w, of.bound, u, v);
      if (of.residual) c = shaded(c, load3(of.residual + 3 * at));
      weights[i] = w, colors[0][i] = c.x, colors[1][i] = c.y, colors[2][i] = c.z;
      if constexpr (kMaps) depths[i] = f.depth[at];
    });
    __syncthreads();
    part.each_pair(s, [&](int j, int i, bool mine) {
      const S b = __shfl_sync(kFullMask, beta, j);
      S normal[3] = {S(0), S(0), S(0)};
      if constexpr (kMaps) {
        normal[0] = __shfl_sync(kFullMask, nx, j), normal[1] = __shfl_sync(kFullMask, ny, j);
        normal[2] = __shfl_sync(kFullMask, nz, j);
      }
      if (!mine) return;
      const S color[3] = {colors[0][i], colors[1][i], colors[2][i]};
      add_blended<kMaps>(weights[i], color, b, depths[kMaps ? i : 0], normal, sum);
    });
  }
  if (s.x >= p.width || s.y >= p.height) return;
  S* to = image + (int64_t(s.y) * p.width + s.x) * kChannels;
  for (int c = 0; c < kChannels; ++c) to[c] = sum[c];
}

// Source of residual colours: none, texels, or one listed per fragment.
enum class Residual { kNone, kTexels, kListed };
// Resident blocks per multiprocessor, as registers allow: texel fetches and the sums of their gradients take 80 in
// single precision.
template <class S, bool kMaps, Residual kResidual> constexpr int resident() {
  if (sizeof(S) == 8) return 1;
  return kResidual == Residual::kTexels ? (kMaps ? 2 : 3) : (kMaps ? 4 : 5);
}

// Runs are read and written from a multiple of 8 fragments, as whole sectors of 32 bytes are faster than parts.
template <class S, bool kMaps, Residual kResidual, bool kExact>
__global__ void __launch_bounds__(kTileThreads, resident<S, kMaps, kResidual>())
    backward_kernel(BlendBackward<S, Pairs> a, ExactSums exact) {
  constexpr int kChannels = channels_of(kMaps), kSums = blend_sums(kMaps);
  constexpr int kWorkers = kTileThreads / kRunLanes, kWhole = 8;
  constexpr bool kTexels = kResidual == Residual::kTexels, kListed = kResidual == Residual::kListed;
  __shared__ S gradient[kTileThreads * kChannels];
  const BlendedSurfels<S, Pairs>& of = a.of;
  const Pairs& p = of.fragments.layout;
  const FragmentArrays<S>& f = of.fragments.f;
  const auto [first, end] = block_pairs(p);
  if (first == end) return;
  const TilePart tile(p);
  tile.load<kChannels>(a.dimage, gradient);
  __syncthreads();
  Adder<S, kExact> texel_sums = {};
  if constexpr (kTexels) texel_sums = adder<kExact>(a.work.sums, exact);
  const int lane = int(threadIdx.x) % kRunLanes, worker = int(threadIdx.x) / kRunLanes;
  // Both runs of a warp loop equally often, as its shuffles need all lanes.
  for (int64_t k = first + worker; k - worker % 2 < end; k += kWorkers) {
    const bool some = k < end;
    const int64_t begin = some ? p.offsets[k] : 0;
    const int skipped = int(begin % kWhole), count = some ? int(p.offsets[k + 1] - begin) : 0;
    const int64_t id = some ? p.surfel[k] : 0;
    const TexelPatch<S> patch(of.table, id);
    const S* g = of.geom + id * kGeom;
    const S beta = g[kBeta], normal[3] = {g[kNx], g[kNy], g[kNz]};
    S sums[kSums];  // beta, colour, normal
    BT_UNROLL
    for (int c = 0; c < kSums; ++c) sums[c] = S(0);
    const int own = count ? skipped + count : 0, stop = max_(own, __shfl_xor_sync(kFullMask, own, kRunLanes));
    for (int turn = 0; turn < stop; turn += kRunLanes) {
      const int at = turn - skipped + lane;  // index in the run
      const int64_t i = begin + at;
      const bool mine = at >= 0 && at < count;
      S w = S(0), u = S(0), v = S(0), depth = S(0);
      Vec3<S> residual = {S(0), S(0), S(0)};
      int pixel = 0;
      if (mine) {
        pixel = f.pixel[i], w = f.weight[i];
        if (kTexels && patch.textured()) u = f.uv[i], v = f.uv[f.total + i];
        if constexpr (kMaps) depth = f.depth[i];
        if constexpr (kListed) residual = load3(of.residual + 3 * i);
      }
      __syncwarp();  // all loads are issued before any is used: one wait for all
      const bool textured = kTexels && mine && w >= of.bound && patch.textured();
      TexelCorners<S> corners = {};
      TexelSlopes<S> slopes = {};
      Vec3<S> color = patch.view, dcolor = {S(0), S(0), S(0)};
      if constexpr (kListed) color = shaded(color, residual);
      if (textured) {
        corners = patch.corners(u, v);
        color = patch.color(corners, a.duv != nullptr, slopes);
      }
      if (mine) {
        const S* d = gradient + tile.at(pixel) * kChannels;
        const S rgb[3] = {color.x, color.y, color.z};
        if (a.dweight) a.dweight[i] = weight_gradient<kMaps>(d, rgb, beta, depth, normal);
        dcolor = residual_gradient(color, w * load3(d));
        sums[0] += w * d[4];
        sums[1] += dcolor.x, sums[2] += dcolor.y, sums[3] += dcolor.z;
        if constexpr (kMaps) {
          a.ddepth[i] = w * d[5];
          BT_UNROLL
          for (int c = 0; c < 3; ++c) sums[4 + c] += w * d[6 + c];
        }
        if constexpr (kListed)
          if (a.dresidual) store3(a.dresidual + 3 * i, dcolor);
        if (a.duv) a.duv[i] = dot(dcolor, slopes.u), a.duv[f.total + i] = dot(dcolor, slopes.v);
      }
      if (kTexels && a.moved) {
        const S d[4] = {dcolor.x, dcolor.y, dcolor.z, a.squares ? w * dcolor.x : S(0)};
        add_to_corners(textured ? patch.first + corners.at[0] : int64_t(-1), corners, d, int(threadIdx.x) % kWarp,
                       texel_sums);
      }
    }
    const S sum = sum_over_run(sums, lane);
    if (some && lane < kSums) a.partial[int64_t(p.slot[k]) * kSums + lane] = sum;
  }
}

template <class S> struct StoreSurfelGradient {
  const S* base;
  S *dgeom, *dbase;
  __device__ void operator()(int64_t surfel, int column, S sum) const {
    if (column == 0) dgeom[surfel * kGeom + kBeta] = sum;
    if (column >= 4 && column < 7) dgeom[surfel * kGeom + kNx + column - 4] = sum;
    if (column == 0 || column >= 4) return;
    const int64_t at = 3 * surfel + column - 1;
    dbase[at] = base_gradient(base[at], sum);
  }
};

template <class S, bool kMaps, Residual kResidual, bool kExact>
void run_backward(const BlendBackward<S, Pairs>& a, const ExactSums& exact, Stream stream) {
  const Pairs& p = a.of.fragments.layout;
  if (p.pairs)
    BT_LAUNCH((backward_kernel<S, kMaps, kResidual, kExact>), dim3(unsigned(p.tiles())), dim3(kTileThreads), 0, stream,
              a, exact);
  fill_zero(a.dgeom, p.surfels * kGeom, stream);
  sum_slots<blend_sums(kMaps)>(p, static_cast<const S*>(a.partial),
                               StoreSurfelGradient<S>{a.of.table.base, a.dgeom, a.dbase}, stream);
  if (a.moved)
    each_shown_texel(p, a.of.table, MoveTexel<S, kExact>{a.work.sums, exact, a.share, a.rate, a.moved, a.squares},
                     stream);
}
}  // namespace

template <class S> void blend_forward(const BlendForward<S, Pairs>& a, Stream stream) {
  const dim3 tiles(unsigned(a.of.fragments.layout.tiles())), threads(kTileThreads);
  if (a.of.maps)
    BT_LAUNCH((forward_kernel<S, true>), tiles, threads, 0, stream, a.of, a.image);
  else
    BT_LAUNCH((forward_kernel<S, false>), tiles, threads, 0, stream, a.of, a.image);
}

template <class S, bool kMaps> void backward(const BlendBackward<S, Pairs>& a, Stream stream) {
  const int64_t entries = a.moved ? 4 * a.of.table.texels : 0;
  if (a.work.exact && entries) {
    const ExactSums exact = begin_exact(a.work.exact, entries, static_cast<const FieldArrays<S>*>(nullptr),
                                        a.of.fragments.f.total, a.of.numbers(), a.dimage, stream);
    run_backward<S, kMaps, Residual::kTexels, true>(a, exact, stream);
  } else if (a.of.table.texels) {
    if (entries) each_shown_texel(a.of.fragments.layout, a.of.table, ClearTexel<S>{a.work.sums}, stream);
    run_backward<S, kMaps, Residual::kTexels, false>(a, {}, stream);
  } else if (a.of.residual) {
    run_backward<S, kMaps, Residual::kListed, false>(a, {}, stream);
  } else {
    run_backward<S, kMaps, Residual::kNone, false>(a, {}, stream);
  }
}
template <class S> void blend_backward(const BlendBackward<S, Pairs>& a, Stream stream) {
  a.of.maps ? backward<S, true>(a, stream) : backward<S, false>(a, stream);
}

template void blend_forward(const BlendForward<float, Pairs>&, Stream);
template void blend_forward(const BlendForward<double, Pairs>&, Stream);
template void blend_backward(const BlendBackward<float, Pairs>&, Stream);
template void blend_backward(const BlendBackward<double, Pairs>&, Stream);

}  // namespace bt::cuda
