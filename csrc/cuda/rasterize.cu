// Images of views in one kernel, and the backward pass in another, without writing fragments to memory.
//
// Forward is the pass of trace_mark with shading and blending; it leaves for the backward pass a mask per warp and
// pair, and each pixel's transmittance. Backward, a block goes back through its tile's pairs, as many at a time as
// their fragments fit into shared memory, in four steps:
//   - a pass with one lane per pixel recomputes the fragments and lists them;
//   - turns, kRunLanes lanes for as many fragments of a pair, shade them with most lanes busy, for the gradients of
//     weights and coordinates;
//   - a pass turns gradients of weights into those of sigma, with the sum over fragments behind in a register;
//   - turns again add up the gradients of surfels, colours and texels.
// A pair with many fragments takes many turns, on different lanes; their sums are added in order.
#include "cuda/kernels.h"
#include "cuda/mark.h"
#include "cuda/texel_sums.h"

namespace bt::cuda {

namespace {

template <class S, bool kAlpha, bool kMaps>
__global__ void __launch_bounds__(kTileThreads, sizeof(S) == 8 ? 1 : 4) forward_kernel(RasterizeForward<S> a) {
  using T = FastFloatOr<S>;
  constexpr int kChannels = channels_of(kMaps);
  const TileThread s = tile_thread(a.view.width);
  S sum[kChannels];
  for (int c = 0; c < kChannels; ++c) sum[c] = S(0);
  const S behind = mark_pairs<kAlpha>(a, s, [&](int64_t id, const S* g, const Fragment<T>& f, S weight) {
    const TexelPatch<S> patch(a.table, id);
    const Vec3<S> c = patch.color(weight, a.bound, plain(f.u), plain(f.v));
    const S color[3] = {c.x, c.y, c.z};
    add_blended<kMaps>(weight, color, g[kBeta], plain(f.depth), a.view.geom + id * kGeom + kNx, sum);
  });
  if (s.x >= a.view.width || s.y >= a.view.height) return;
  const int64_t pixel = int64_t(s.y) * a.view.width + s.x;
  for (int c = 0; c < kChannels; ++c) a.image[pixel * kChannels + c] = sum[c];
  a.transmittance[pixel] = behind;
}

// The last pairs before `end`, at most 32, with at most kHeld fragments: one per lane, the last lane has the last. All
// warps of the block get the same.
template <int kHeld> struct LastPairs {
  static_assert(kHeld >= kTileThreads, "no pair has more than a tile's pixels");
  int first_lane;       // first lane with a pair
  int own, begin;       // fragments of the lane's pair, and their start among these
  uint32_t mark, cuts;  // the warp's pixels that blend the lane's pair, and those where alpha texels multiplied sigma
  int from;             // start of the warp's fragments of the lane's pair

  // Pairs from `listed` on have no masks.
  __device__ LastPairs(const Pairs& p, const uint32_t* cut_masks, const TileThread& s, int64_t begin_pair,
                       int64_t listed, int64_t end)
      : own(0), mark(0), cuts(0), from(0) {
    const int64_t k = end - kWarp + s.lane;
    if (k >= begin_pair && k < listed) {
      BT_UNROLL
      for (int w = 0; w < kTileWarps; ++w) {
        const uint32_t bits = p.masks[w * p.pairs + k];
        if (w == s.warp) mark = bits, from = own;
        own += __popc(bits);
      }
      if (cut_masks && mark) cuts = cut_masks[s.warp * p.pairs + k];
    }
    const int before = sum_below(own, s.lane), all = __shfl_sync(kFullMask, before + own, kWarp - 1);
    first_lane = kWarp - __popc(__ballot_sync(kFullMask, k >= begin_pair && all - before <= kHeld));
    begin = before - __shfl_sync(kFullMask, before, first_lane), from += begin;
    if (s.lane < first_lane) mark = 0, own = 0;
  }
  // Calls use(j, i, mine, cut) for the pairs with a fragment in the calling warp, back to front: lane j has the pair, i
  // is the fragment of the lane's pixel, if `mine`.
  template <class Use> __device__ void each_pair_back(const TileThread& s, Use&& use) const {
    for (unsigned todo = __ballot_sync(kFullMask, mark != 0); todo;) {
      const int j = take_last(todo);
      const unsigned taken = __shfl_sync(kFullMask, mark, j), cut = __shfl_sync(kFullMask, cuts, j);
      use(j, __shfl_sync(kFullMask, from, j) + count_below(taken, s.lane), bool(taken >> s.lane & 1u),
          bool(cut >> s.lane & 1u));
    }
  }
};

// A fragment's pixel in the tile, and flags: colour channels above 0, multiplied by alpha, textured.
enum FragmentBits { kPixel = kTileThreads - 1, kOpenRed = kTileThreads, kCut = 8 * kOpenRed, kTextured = 2 * kCut };

// The fragments of LastPairs, and their turns, each of up to kRunLanes fragments of one pair.
template <class S, bool kMaps> struct Held : SurfelRows<S> {
  static constexpr int kFragments = sizeof(S) == 8 ? (kMaps ? 256 : 320) : (kMaps ? 768 : 1024);
  static constexpr int kTurns = kFragments / kRunLanes + kWarp, kChannels = channels_of(kMaps);
  static constexpr int kColors = blend_sums(kMaps);  // sums of a pair: view colour and, from kNormal on, normal
  static constexpr int kNormal = 4;
  S gradient[kTileThreads * kChannels];
  S weight[kFragments], u[kFragments], v[kFragments], sigma[kFragments];  // sigma as listed
  S dsigma[kFragments], du[kFragments], dv[kFragments];  // dsigma holds dL/dweight first, before that the maps' part
  S sums[kTurns * kTraceSums], color_sums[kTurns * kColors];
  int32_t bits[kFragments], begin[kWarp], count[kWarp], first_turn[kWarp];
  uint8_t pair[kTurns];
  int turns;

  // Assigns turns, by one warp.
  __device__ void make_turns(const LastPairs<kFragments>& part, int lane) {
    const int own = (part.own + kRunLanes - 1) / kRunLanes;
    const int first = sum_below(own, lane);
    first_turn[lane] = first, begin[lane] = part.begin, count[lane] = part.own;
    for (int t = first; t < first + own; ++t) pair[t] = uint8_t(lane);
    if (lane == kWarp - 1) turns = first + own;
  }
  // Calls take(turn, j, i, mine) by all threads, equally often in all lanes of a warp; `turn` may be past the last.
  template <class Take> __device__ void each_turn(Take&& take) const {
    constexpr int kWorkers = kTileThreads / kRunLanes;
    const int lane = int(threadIdx.x) % kRunLanes, worker = int(threadIdx.x) / kRunLanes;
    for (int turn = worker; turn - worker % 2 < turns; turn += kWorkers) {
      const bool some = turn < turns;
      const int j = some ? int(pair[turn]) : kWarp - 1;
      const int at = some ? (turn - first_turn[j]) * kRunLanes + lane : kFragments;
      take(turn, j, begin[j] + at, at < count[j]);
    }
  }
  // Writes the sums of each pair's turns, kColumns numbers, to its slot.
  template <int kColumns>
  __device__ void put(const S* of_turns, const int32_t* slots, int first_lane, S* partial) const {
    for (int c = int(threadIdx.x); c < kWarp * kColumns; c += kTileThreads) {
      const int j = c / kColumns, column = c % kColumns;
      if (j < first_lane) continue;
      const int end = first_turn[j] + (count[j] + kRunLanes - 1) / kRunLanes;
      S sum = S(0);
      for (int t = first_turn[j]; t < end; ++t) sum += of_turns[t * kColumns + column];
      partial[int64_t(slots[j]) * kColumns + column] = sum;
    }
  }
};

template <class S, bool kAlpha, bool kTexels, bool kMaps>
__global__ void __launch_bounds__(kTileThreads, sizeof(S) == 8 ? 1
                                                : kMaps        ? 2
                                                               : 3) backward_kernel(RasterizeBackward<S> a) {
  using T = FastFloatOr<S>;
  using Chunk = Held<S, kMaps>;
  constexpr int kColors = Chunk::kColors, kChannels = Chunk::kChannels;
  __shared__ Chunk held;
  const Pairs& p = a.layout;
  const TileThread s = tile_thread(p.width);
  const auto [first, last] = block_pairs(p);
  if (first == last) return;
  const int64_t listed = p.tile_pairs[blockIdx.x + 1];
  TilePart(p).load<kChannels>(a.dimage, held.gradient);
  const int tile_left = s.left - s.left % kTile, tile_top = s.top - s.top % kTile;
  const int lane = int(threadIdx.x) % kRunLanes;
  S transmittance = S(1);
  if (s.x < p.width && s.y < p.height) transmittance = a.transmittance[int64_t(s.y) * p.width + s.x];
  T later = T(S(0));  // sum of w dL/dw
  int64_t end = last;
  while (end > first) {
    const LastPairs<Chunk::kFragments> part(p, kAlpha ? a.cuts : nullptr, s, first, listed, end);
    const int64_t lanes = end - kWarp;  // pair of lane 0
    end -= kWarp - part.first_lane;
    if (s.warp == 0) held.make_turns(part, s.lane);
    held.load(a.view.geom, p.surfel + lanes, part.first_lane, kWarp);
    __syncthreads();
    part.each_pair_back(s, [&](int j, int i, bool mine, bool is_cut) {
      S g[kGeom];
      load_shape(held.rows[j].g, g);
      const T dx = T(pixel_centre<S>(s.x) - g[kCx]), dy = T(pixel_centre<S>(s.y) - g[kCy]);
      const Fragment<T> f =
          fragment<LowPassKernel>(g, a.view.near, dx, dy, __any_sync(kFullMask, mine && near_centre(dx, dy)));
      if (!mine) return;
      // the forward pass found at least that much, perhaps rounded differently
      S sigma = max_(plain(f.sigma), S(kAlphaMin));
      if (kAlpha && is_cut) {
        const AlphaPatch<S> patch(a.alpha, held.ids[j]);
        S t[4];
        sigma = max_(alpha_cut(sigma, patch.fetch(patch.corners(plain(f.u), plain(f.v)), t)), S(kAlphaMin));
      }
      transmittance /= S(1) - sigma;
      held.weight[i] = sigma * transmittance;
      held.u[i] = plain(f.u), held.v[i] = plain(f.v);
      held.sigma[i] = plain(f.low_pass) > S(0) ? -sigma : sigma;
      const int pixel = (s.y - tile_top) * kTile + s.x - tile_left;
      held.bits[i] = pixel + (is_cut ? kCut : 0);
      if constexpr (kMaps)
        held.dsigma[i] = map_gradient(held.gradient + pixel * kChannels, plain(f.depth), held.rows[j].g + kNx);
    });
    __syncthreads();
    held.each_turn([&](int, int j, int i, bool mine) {
      if (!mine) return;
      const TexelPatch<S> patch(a.table, held.ids[j]);
      const S w = held.weight[i];
      int bits = held.bits[i];
      const S* d = held.gradient + (bits & kPixel) * kChannels;
      Vec3<S> color = patch.view;
      if (kTexels && w >= a.bound && patch.textured()) {
        bits |= kTextured;
        const TexelCorners<S> corners = patch.corners(held.u[i], held.v[i]);
        TexelSlopes<S> slopes = {};
        color = patch.color(corners, a.moves, slopes);
        if (a.moves) {
          const Vec3<S> dcolor = residual_gradient(color, w * load3(d));
          held.du[i] = dot(dcolor, slopes.u), held.dv[i] = dot(dcolor, slopes.v);
        }
      }
      const S rgb[3] = {color.x, color.y, color.z};
      BT_UNROLL
      for (int c = 0; c < 3; ++c)
        if (rgb[c] > S(0)) bits |= kOpenRed << c;
      const S dweight = image_gradient(d, rgb, held.rows[j].g[kBeta]);
      held.dsigma[i] = kMaps ? held.dsigma[i] + dweight : dweight;
      held.bits[i] = bits;
    });
    __syncthreads();
    part.each_pair_back(s, [&](int, int i, bool mine, bool) {
      if (mine) held.dsigma[i] = plain(blend_vjp(T(held.weight[i]), T(abs_(held.sigma[i])), T(held.dsigma[i]), later));
    });
    __syncthreads();
    held.each_turn([&](int turn, int j, int i, bool mine) {
      const int64_t id = held.ids[j];
      S g[kGeom];
      load_shape(held.rows[j].g, g);
      T sums[kTraceSums], ddx = T(S(0)), ddy = T(S(0));
      BT_UNROLL
      for (int c = 0; c < kTraceSums; ++c) sums[c] = T(S(0));
      int bits = 0;
      S sigma = S(0), gs = S(0), gu = S(0), gv = S(0), gz = S(0), dcolor[kColors] = {};
      if (mine) {
        bits = held.bits[i], sigma = held.sigma[i], gs = held.dsigma[i];
        const S w = held.weight[i], *d = held.gradient + (bits & kPixel) * kChannels;
        BT_UNROLL
        for (int c = 0; c < 3; ++c) dcolor[c] = bits & (kOpenRed << c) ? w * d[c] : S(0);
        sums[kBeta] = T(w * d[4]);
        if constexpr (kMaps) {
          gz = w * d[5];
          BT_UNROLL
          for (int c = 0; c < 3; ++c) dcolor[Chunk::kNormal + c] = w * d[6 + c];
        }
        if (a.moves && bits & kTextured) gu = held.du[i], gv = held.dv[i];
      }
      if constexpr (kTexels) {
        TexelCorners<S> corners = {};
        int64_t texel = -1;
        S of_texels[kAlpha ? 4 : 3] = {};
        if (bits & (kTextured | kCut)) {
          const TexelPatch<S> patch(a.table, id);
          corners = patch.corners(held.u[i], held.v[i]), texel = patch.first + corners.at[0];
          BT_UNROLL
          for (int c = 0; c < 3; ++c) of_texels[c] = bits & kTextured ? dcolor[c] : S(0);
          if constexpr (kAlpha)
            if (bits & kCut) of_texels[3] = alpha_vjp(AlphaPatch<S>(a.alpha, id), corners, sigma, gs, gu, gv);
        }
        if (a.step.sums)
          add_to_corners(texel, corners, of_texels, int(threadIdx.x) % kWarp, Adder<S, false>{a.step.sums});
      }
      if (mine) {
        const int pixel = bits & kPixel;
        fragment_vjp<S, T>(g, a.view.near, a.rim, T(pixel_centre<S>(tile_left + pixel % kTile) - g[kCx]),
                           T(pixel_centre<S>(tile_top + pixel / kTile) - g[kCy]), T(sigma), T(gs), T(gu), T(gv), T(gz),
                           sums, ddx, ddy);
      }
      sums[kShape] = abs_(ddx), sums[kShape + 1] = abs_(ddy);
      S plain_sums[kTraceSums];
      BT_UNROLL
      for (int c = 0; c < kTraceSums; ++c) plain_sums[c] = plain(sums[c]);
      const S sum = sum_over_run(plain_sums, lane), color_sum = sum_over_run(dcolor, lane);
      if (turn >= held.turns) return;
      held.sums[turn * kTraceSums + lane] = sum;
      if (lane < kColors) held.color_sums[turn * kColors + lane] = color_sum;
    });
    __syncthreads();
    held.template put<kTraceSums>(held.sums, p.slot + lanes, part.first_lane, a.partial);
    held.template put<kColors>(held.color_sums, p.slot + lanes, part.first_lane, a.color_partial);
    __syncthreads();  // before the next chunk
  }
}

template <class S, bool kMaps> struct StoreColorGradient {
  const S* base;
  S *dbase, *dgeom;
  __device__ void operator()(int64_t surfel, int column, S sum) const {
    constexpr int kNormal = Held<S, kMaps>::kNormal;
    if (column >= kNormal && column < kNormal + 3) dgeom[surfel * kGeom + kNx + column - kNormal] = sum;
    if (column >= 3) return;
    const int64_t at = 3 * surfel + column;
    dbase[at] = base_gradient(base[at], sum);
  }
};

// Takes the gradient step on a texel's colour, and writes the gradient of its alpha.
template <class S> struct PutTexel {
  MoveTexel<S, false> color;
  S* dalpha;
  __device__ void operator()(int64_t t) const {
    if (color.moved) color(t);
    if (dalpha) dalpha[t] = color.sums[4 * t + 3];
  }
};
}  // namespace

template <class S> void rasterize_forward(const RasterizeForward<S>& a, Stream stream) {
  const auto run = a.maps ? (a.alpha.values ? forward_kernel<S, true, true> : forward_kernel<S, false, true>)
                          : (a.alpha.values ? forward_kernel<S, true, false> : forward_kernel<S, false, false>);
  BT_LAUNCH(run, dim3(unsigned(tiles_of(a.view.width, a.view.height))), dim3(kTileThreads), 0, stream, a);
}

template <class S, bool kMaps> void backward(const RasterizeBackward<S>& a, Stream stream) {
  const Pairs& p = a.layout;
  const auto run = a.alpha.values   ? backward_kernel<S, true, true, kMaps>
                   : a.table.texels ? backward_kernel<S, false, true, kMaps>
                                    : backward_kernel<S, false, false, kMaps>;
  if (p.pairs) BT_LAUNCH(run, dim3(unsigned(p.tiles())), dim3(kTileThreads), 0, stream, a);
  sum_slots<kTraceSums>(p, static_cast<const S*>(a.partial), StoreGeomGradient<S>{a.dgeom, a.absgrad}, stream);
  sum_slots<Held<S, kMaps>::kColors>(p, static_cast<const S*>(a.color_partial),
                                     StoreColorGradient<S, kMaps>{a.table.base, a.dbase, a.dgeom}, stream);
}

template <class S> void rasterize_backward(const RasterizeBackward<S>& a, Stream stream) {
  const TexelStep<S>& step = a.step;
  if (step.sums) each_shown_texel(a.layout, a.table, ClearTexel<S>{step.sums}, stream);
  fill_zero(step.dalpha, step.dalpha ? a.alpha.texels : 0, stream);
  a.maps ? backward<S, true>(a, stream) : backward<S, false>(a, stream);
  if (step.sums) {
    const MoveTexel<S, false> color = {step.sums, {}, step.share, step.rate, step.moved, nullptr};
    each_shown_texel(a.layout, a.table, PutTexel<S>{color, step.dalpha}, stream);
  }
}

BT_INSTANTIATE(rasterize_forward, RasterizeForward)
BT_INSTANTIATE(rasterize_backward, RasterizeBackward)

}  // namespace bt::cuda
