// Traversal of a tile's surfels, with the alpha texels of a block's fragments.
#pragma once

#include "core/kernel.h"
#include "core/visibility.h"
#include "cpu/blocks.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"

namespace bt {

// Marks, in the last bit of v, fragments whose sigma was multiplied.
template <class S> Lanes<S> marked(Lanes<S> v, uint32_t lanes) {
  using V = typename Lanes<S>::V;
  using I = typename Lanes<S>::I;
  const I even = same_bits<I>(v.v) & ~1;
  return choose(mask_of<S>(lanes), same_bits<V>(even + 1), same_bits<V>(even));
}
template <class S> uint32_t marks(Lanes<S> v) {
  using V = typename Lanes<S>::V;
  using I = typename Lanes<S>::I;
  return bits(Lanes<S>(convert<V>(same_bits<I>(v.v) & 1)) > Lanes<S>(S(0.5)));
}

// Prefetches the tile entry of a surfel a few steps ahead, the texels of the next surfel, and their gradients.
template <class S> BT_HD void prefetch_tile(const AlphaTiles<S>& tiles, int64_t id) {
  __builtin_prefetch(tiles.first + id), __builtin_prefetch(tiles.size + 2 * id), __builtin_prefetch(tiles.extent + id);
}
template <class S> BT_HD void prefetch_texels(const AlphaTiles<S>& tiles, int64_t id, const S* of_texels) {
  constexpr int kLine = 64 / sizeof(S), kMost = 4 * kLine;
  const int64_t first = tiles.first[id], area = int64_t(tiles.size[2 * id]) * tiles.size[2 * id + 1];
  for (int64_t t = first; t < first + std::min<int64_t>(area, kMost); t += kLine) {
    __builtin_prefetch(tiles.values + t);
    if (of_texels) __builtin_prefetch(of_texels + t, 1);
  }
}
// Loads two adjacent texels per lane, the left one at first[lane] of a tile; the left one twice unless `both`.
template <class S>
BT_HD void load_sides(const S* tile, const int32_t* first, bool both, Lanes<S>& left, Lanes<S>& right) {
#if defined(__AVX2__)
  if constexpr (std::is_same_v<S, float>) {
    if (both) {
      const auto two = [&](int lane) {
        const __m128 one = _mm_castsi128_ps(_mm_loadl_epi64((const __m128i*)(tile + first[lane])));
        return _mm_loadh_pi(one, (const __m64*)(tile + first[lane + 1]));
      };
      const auto four = [&](int lane) {
        return _mm256_insertf128_ps(_mm256_castps128_ps256(two(lane)), two(lane + 4), 1);
      };
      const __m256 a = four(0), b = four(2), c = four(8), d = four(10);
      left = joined(_mm256_shuffle_ps(a, b, 0x88), _mm256_shuffle_ps(c, d, 0x88));
      right = joined(_mm256_shuffle_ps(a, b, 0xdd), _mm256_shuffle_ps(c, d, 0xdd));
      return;
    }
  }
#endif
  for (int lane = 0; lane < kLanes; ++lane)
    left.set(lane, tile[first[lane]]), right.set(lane, tile[first[lane] + int(both)]);
}
// Alpha texels of a subset of a block's fragments; undefined for others.
template <class S> class AlphaLanes {
 public:
  using P = Lanes<S>;
  AlphaLanes(const AlphaPatch<S>& patch, P u, P v, uint32_t lanes)
      : lanes_(lanes),
        patch_(patch),
        next_(patch.size),
        x_(texel_axis(u, patch.size[0], patch.extent)),
        y_(texel_axis(v, patch.size[1], patch.extent)) {
    const P first = y_.first * P(S(patch.size[0])) + x_.first;
    store_integers(first_, select(mask_of<S>(lanes), first, P(S(0))));
    load_sides(patch.tile, first_, next_.right, t_[0], t_[1]);
    load_sides(patch.tile + next_.down, first_, next_.right, t_[2], t_[3]);
  }
  P sigma(P uncut) const {
    return select(mask_of<S>(lanes_), alpha_cut(uncut, texel_lerp(t_, x_.fraction, y_.fraction)), uncut);
  }
  // Computes alpha_vjp, and adds the texels' gradients to `to`, unless null.
  void gradient(P& listed, P& gs, P& gu, P& gv, S* to) const {
    P of[] = {listed, gs, gu, gv};
    const P dm = alpha_vjp(patch_, t_, x_, y_, of[0], of[1], of[2], of[3]);
    P* const all[] = {&listed, &gs, &gu, &gv};
    for (int k = 0; k < 4; ++k) *all[k] = select(mask_of<S>(lanes_), of[k], *all[k]);
    if (!to) return;
    P weight[4];
    S by_corner[4][kLanes];
    texel_weights(x_.fraction, y_.fraction, weight);
    for (int k = 0; k < 4; ++k) store(by_corner[k], weight[k] * dm);
    each_lane(lanes_, [&](int lane) {
      S *above = to + first_[lane], *below = above + next_.down;
      above[0] += by_corner[0][lane], above[next_.right] += by_corner[1][lane];
      below[0] += by_corner[2][lane], below[next_.right] += by_corner[3][lane];
    });
  }

 private:
  uint32_t lanes_;
  const AlphaPatch<S>& patch_;
  TexelSteps next_;
  TexelAxis<P> x_, y_;
  int32_t first_[kLanes];
  P t_[4];
};
// Multiplies the sigma of a block's fragments by alpha where the weight reaches the bound, and marks them.
template <class S>
void cut(const AlphaTiles<S>& tiles, int64_t id, const typename Lanes<S>::M& covered, Lanes<S> transmittance,
         Fragment<Lanes<S>>& f) {
  const AlphaPatch<S> patch(tiles, id);
  if (!patch.textured()) return;
  const uint32_t lanes = bits(covered & (blend(f.sigma, transmittance).weight >= Lanes<S>(tiles.bound)));
  f.v = marked(f.v, lanes);
  if (lanes) f.sigma = AlphaLanes<S>(patch, f.u, f.v, lanes).sigma(f.sigma);
}

// Prefetches the row of a surfel a few steps ahead.
constexpr int kAhead = 3;
template <class S> BT_HD void prefetch(const View<S>& view, const Bins& bins, int64_t id) {
  __builtin_prefetch(view.geom + id * kGeom);
  __builtin_prefetch(view.radii + 2 * id);
  __builtin_prefetch(bins.level.data() + 2 * id);
}

// Cells of 16 with a pixel in the kernel's level set, and in that of the low pass.
struct ReachedCells {
  uint32_t support, centre;
};
template <class S>
BT_HD ReachedCells reached_cells(const S* g, Lanes<S> x, Lanes<S> y, S half_x, S half_y, const float* level) {
  const Reached<Lanes<S>> r = reached(g, x, y, half_x, half_y, S(level[0]), S(level[1]));
  return {bits(r.support), bits(r.centre)};
}

// Transmittance of a tile while its surfels are drawn front to back.
template <class S> struct TileState {
  using P = Lanes<S>;
  using M = typename P::M;
  P transmittance[kBlocks];
  M open[kBlocks];           // pixels inside the image that are not ended
  uint32_t open_blocks = 0;  // bit per block with such pixels
  S x0, y0;                  // the tile's first pixel
  S stop;                    // transmittance at which a pixel ends
  P lane_x, lane_y;          // pixel centres of a block
  P middle_x, middle_y;      // middles of the blocks, from the tile's corner

  TileState(int tile_x, int tile_y, int width, int height, S stop = S(kTransmittanceMin)) : stop(stop) {
    x0 = S(tile_x * kTile), y0 = S(tile_y * kTile);
    const BlockCentres<S> centres;
    lane_x = centres.x, lane_y = centres.y;
    for (int p = 0; p < kBlocks; ++p) {
      transmittance[p] = P(S(1));
      const S column = kBlockOffsets<S>.column[p], row = kBlockOffsets<S>.row[p];
      const P px = P(x0 + column) + lane_x, py = P(y0 + row) + lane_y;
      open[p] = (px < P(S(width))) & (py < P(S(height)));
      open_blocks |= uint32_t(bits(open[p]) != 0) << p;
      middle_x.set(p, column + S(0.5 * kBlockSide)), middle_y.set(p, row + S(0.5 * kBlockSide));
    }
  }

  // Blends surfel `id`: fn(block, mask, fragment, weight) for every block with a pixel that takes it. Without kAll the
  // fragment lacks depth and low_pass. cut(fragment, mask, transmittance): applies alpha texels to sigma.
  template <class Kernel, bool kAll, class F, class C>
  void blend(const View<S>& view, const Bins& bins, int64_t id, F&& fn, S sharp, C&& cut) {
    const S *g = view.geom + id * kGeom, cx = g[kCx] - x0, cy = g[kCy] - y0;
    const ReachedCells r = reached_in_tile(g, cx, cy, view.radii + 2 * id, bins.level.data() + 2 * id);
    uint32_t blocks = open_blocks & (r.support | r.centre);
    // all fragments before any branch on them, to overlap their latencies
    Fragment<P> found[kBlocks];
    int at[kBlocks], n = 0;
    for (; blocks; blocks &= blocks - 1) {
      const int block = __builtin_ctz(blocks);
      const P dx = lane_x + P(kBlockOffsets<S>.column[block] - cx), dy = lane_y + P(kBlockOffsets<S>.row[block] - cy);
      const Fragment<P> f = fragment<Kernel>(g, view.near, dx, dy, r.centre >> block & 1, sharp);
      Fragment<P>& to = found[n];
      to.u = f.u, to.v = f.v, to.sigma = f.sigma;
      if constexpr (kAll) to.depth = f.depth, to.low_pass = f.low_pass;
      at[n++] = block;
    }
    for (int i = 0; i < n; ++i) {
      cut(found[i], open[at[i]] & (found[i].sigma >= P(S(kAlphaMin))), transmittance[at[i]]);
      take_fragment(at[i], found[i], fn);
    }
  }
  template <class Kernel, bool kAll, class F>
  void blend(const View<S>& view, const Bins& bins, int64_t id, F&& fn, S sharp = S(1)) {
    blend<Kernel, kAll>(view, bins, id, fn, sharp, [](const Fragment<P>&, const M&, const P&) {});
  }

 private:
  template <class F> void take_fragment(int block, const Fragment<P>& f, F& fn) {
    const Blend<P> b = bt::blend(f.sigma, transmittance[block]);
    const BlendTest<P> v = blend_test(open[block], f.sigma, b.behind, P(stop));
    if (!bits(v.takes | v.ends)) return;
    open[block] = open[block] & ~v.ends;
    transmittance[block] = select(v.takes, b.behind, transmittance[block]);
    if (bits(v.takes)) fn(block, v.takes, f, b.weight);
    if (!bits(open[block])) open_blocks &= ~(1u << block);
  }
  ReachedCells reached_in_tile(const S* g, S cx, S cy, const S* radius, const float* level) const {
    constexpr S kHalf = S(0.5 * (kBlockSide - 1));
    const P x = middle_x - P(cx), y = middle_y - P(cy);
    const S half_x = cell_half(kHalf, cx, S(kTile)), half_y = cell_half(kHalf, cy, S(kTile));
    // the centre of a disc without a box may lie beyond its radii
    const bool boxless = max_(radius[0], radius[1]) >= S(kBoxless);
    const uint32_t box =
        boxless ? ~uint32_t(0) : bits((abs_(x) < P(radius[0] + half_x)) & (abs_(y) < P(radius[1] + half_y)));
    const ReachedCells r = reached_cells(g, x, y, half_x, half_y, level);
    return {box & r.support, box & r.centre};
  }
};

// Visits the surfels that a tile may show, front to back, while a pixel is open: fn(surfel, blend), where blend(take)
// blends the surfel with its alpha texels as TileState::blend.
template <bool kAll, class S, class F>
void each_surfel(const View<S>& view, const AlphaTiles<S>& alpha, const Bins& bins, int64_t tile, F&& fn) {
  using P = Lanes<S>;
  TileState<S> state(int(tile % bins.tiles_x), int(tile / bins.tiles_x), view.width, view.height);
  const int64_t end = bins.start[tile + 1];
  for (int64_t k = bins.start[tile]; k < end && state.open_blocks; ++k) {
    if (k + kAhead < end) prefetch(view, bins, bins.surfels[k + kAhead]);
    const int32_t id = bins.surfels[k];
    if (!alpha.values) {
      fn(id, [&](auto&& take) { state.template blend<LowPassKernel, kAll>(view, bins, id, take); });
      continue;
    }
    if (k + 2 * kAhead < end) {
      prefetch_tile<S>(alpha, bins.surfels[k + 2 * kAhead]);
      prefetch_texels<S>(alpha, bins.surfels[k + kAhead], nullptr);
    }
    const auto cut_by = [&](Fragment<P>& f, const typename P::M& covered, const P& transmittance) {
      cut(alpha, id, covered, transmittance, f);
    };
    fn(id, [&](auto&& take) { state.template blend<LowPassKernel, kAll>(view, bins, id, take, S(1), cut_by); });
  }
}

}  // namespace bt
