// Fragments of a view. One block per tile, one warp per 8 x 4 pixels, one lane per pixel; warps are independent.
//
// The weights decide which pairs are blended, so the list's length is known only after all sigma are: trace_mark finds
// the masks, a scan gives every fragment its offset, trace_fill writes the fragments, evaluating marked pairs only.
// trace_mark is bound by arithmetic (about 100 operations per lane and pair, a third of the lanes with a fragment),
// trace_fill also by the 28 bytes it writes per fragment.
#include "cuda/kernels.h"
#include "cuda/mark.h"
#include "cuda/sort_scan.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

struct MarkSpace {
  int32_t* counts;
  int64_t temp_size;
  void* temp;
  MarkSpace(Arena& arena, int64_t pairs)
      : counts(arena.take<int32_t>(pairs + 1)),
        temp_size(scan_workspace(pairs + 1)),
        temp(arena.take<char>(temp_size)) {}
};

template <class S, bool kAlpha> __global__ void __launch_bounds__(kTileThreads) mark_kernel(MarkedView<S> a) {
  mark_pairs<kAlpha>(a, tile_thread(a.view.width), [](int64_t, const S*, const Fragment<FastFloatOr<S>>&, S) {});
}

// Pairs after those of the tiles have no masks.
__global__ void __launch_bounds__(kThreads)
    size_kernel(int64_t pairs, const int64_t* listed, const uint32_t* masks, int32_t* counts) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k > pairs) return;
  int32_t count = 0;
  if (k < *listed)
    for (int w = 0; w < kTileWarps; ++w) count += __popc(masks[w * pairs + k]);
  counts[k] = count;
}

// A warp has about ten fragments of a pair, which rarely fill a sector of 32 bytes, and partial sectors are slower to
// write than whole ones. So a block collects the fragments of up to 32 pairs, in list order, and writes them
// contiguously.
template <class S, bool kAlpha>
__global__ void __launch_bounds__(kTileThreads, sizeof(S) == 8 ? 1
                                                : kAlpha       ? 5
                                                               : 6)
    fill_kernel(const S* geom, S near, AlphaTiles<S> alpha, Pairs p, FragmentArrays<S> out) {
  using T = FastFloatOr<S>;
  constexpr int kHeld = 4096 / sizeof(S);
  __shared__ SurfelRows<S> held;
  __shared__ int bits[kTileWarps][kWarp];
  __shared__ int32_t surfels[kHeld], pixels[kHeld];
  __shared__ S weights[kHeld], us[kHeld], vs[kHeld], depths[kHeld], sigmas[kHeld];
  const TileThread s = tile_thread(p.width);
  const S x = pixel_centre<S>(s.x), y = pixel_centre<S>(s.y);
  const int32_t pixel = int32_t(s.y * p.width + s.x);
  const int64_t end = p.tile_pairs[blockIdx.x + 1];
  S transmittance = S(1);
  int taken_pairs = 0;
  for (int64_t first = p.tile_pairs[blockIdx.x]; first < end; first += taken_pairs) {
    Stretch<kHeld> part(p, s, first, end, bits);
    taken_pairs = part.pairs;
    if (!taken_pairs) return;
    held.load(geom, p.surfel + first, 0, taken_pairs);
    __syncthreads();  // rows are loaded, and the previous chunk is written
    part.find_own(s);
    part.each_pair(s, [&](int j, int i, bool mine) {
      S g[kGeom];
      load_shape(held.rows[j].g, g);
      const T dx = T(x - g[kCx]), dy = T(y - g[kCy]);
      const Fragment<T> f =
          fragment<LowPassKernel>(g, near, dx, dy, __any_sync(kFullMask, mine && near_centre(dx, dy)));
      if (!mine) return;
      // trace_mark found at least that much. Where the kernel is discontinuous, different rounding may give 0 here, and
      // the gradient would divide by it.
      S sigma = max_(plain(f.sigma), S(kAlphaMin)), v = plain(f.v);
      if constexpr (kAlpha) {
        const S uncut = sigma;
        cut(alpha, held.ids[j], transmittance, plain(f.u), v, sigma);
        // far less means a weight at the bound, which trace_mark found to be below it
        if (sigma < S(0.5 * kAlphaMin)) sigma = uncut, v = with_mark(v, false);
        sigma = max_(sigma, S(kAlphaMin));
      }
      const Blend<S> b = blend(sigma, transmittance);
      transmittance = b.behind;
      surfels[i] = held.ids[j], pixels[i] = pixel;
      weights[i] = b.weight;
      us[i] = plain(f.u), vs[i] = v;
      depths[i] = plain(f.depth);
      sigmas[i] = plain(f.low_pass) > S(0) ? -sigma : sigma;
    });
    __syncthreads();
    part.each_fragment([&](int i, int64_t at) {
      out.surfel[at] = surfels[i], out.pixel[at] = pixels[i];
      out.weight[at] = weights[i];
      out.uv[at] = us[i], out.uv[out.total + at] = vs[i];
      out.depth[at] = depths[i];
      out.sigma[at] = sigmas[i];
    });
  }
}

// Counts each surfel's fragments on the pixels of `mask` by the pairs' bit masks, without reading the list.
__global__ void __launch_bounds__(kTileThreads) counts_kernel(Pairs p, const uint8_t* mask, int32_t* counts) {
  const TileThread s = tile_thread(p.width);
  const bool on = s.x < p.width && s.y < p.height && mask[int64_t(s.y) * p.width + s.x];
  const unsigned pixels = __ballot_sync(kFullMask, on);
  if (!pixels) return;
  for (int64_t k = p.tile_pairs[blockIdx.x] + s.lane; k < p.tile_pairs[blockIdx.x + 1]; k += kWarp) {
    const int count = __popc(p.masks[s.warp * p.pairs + k] & pixels);
    if (count) atomicAdd(counts + p.surfel[k], count);  // integers: order-independent
  }
}

// Pairs without fragments, such as those after the tiles', may have no masks.
__global__ void __launch_bounds__(kThreads)
    select_kernel(Pairs p, const uint8_t* keep, uint32_t* masks, int64_t* counts) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k >= p.pairs) return;
  int64_t at = p.offsets[k];
  const bool some = at < p.offsets[k + 1];
  int count = 0;
  for (int w = 0; w < kTileWarps; ++w) {
    uint32_t kept = 0;
    for (uint32_t mark = some ? p.masks[w * p.pairs + k] : 0; mark; mark &= mark - 1)
      if (keep[at++]) kept |= mark & (~mark + 1);
    masks[w * p.pairs + k] = kept;
    count += __popc(kept);
  }
  counts[k] = count;
}
}  // namespace

int64_t trace_mark_workspace(int64_t pairs) { return space_bytes<MarkSpace>(pairs); }

template <class S> void trace_mark(const TraceMark<S>& a, Stream stream) {
  const int64_t pairs = a.pairs, tiles = tiles_of(a.view.width, a.view.height);
  const MarkSpace w = cut_space<MarkSpace>(a.workspace, pairs);
  const auto mark = a.alpha.values ? mark_kernel<S, true> : mark_kernel<S, false>;
  if (pairs) BT_LAUNCH(mark, dim3(unsigned(tiles)), dim3(kTileThreads), 0, stream, a);
  BT_LAUNCH_EACH(size_kernel, pairs + 1, kThreads, stream, pairs, a.tile_pairs + tiles, a.masks, w.counts);
  exclusive_sum(w.counts, a.offsets, pairs + 1, w.temp, w.temp_size, stream);
}

template <class S> void trace_fill(const TraceFill<S>& a, Stream stream) {
  const Pairs& p = a.fragments.layout;
  if (!p.fragments) return;
  const auto fill = a.alpha.values ? fill_kernel<S, true> : fill_kernel<S, false>;
  BT_LAUNCH(fill, dim3(unsigned(p.tiles())), dim3(kTileThreads), 0, stream, a.view.geom, a.view.near, a.alpha, p,
            a.fragments.f);
}

void masked_counts(const MaskedCounts<Pairs>& a, Stream stream) {
  if (!a.layout.pairs) return;
  BT_LAUNCH(counts_kernel, dim3(unsigned(a.layout.tiles())), dim3(kTileThreads), 0, stream, a.layout, a.mask, a.counts);
}

void select_fragments(const SelectPairs& a, Stream stream) {
  BT_LAUNCH_EACH(select_kernel, a.layout.pairs, kThreads, stream, a.layout, a.keep, a.masks, a.counts);
}

BT_INSTANTIATE(trace_mark, TraceMark)
BT_INSTANTIATE(trace_fill, TraceFill)

}  // namespace bt::cuda
