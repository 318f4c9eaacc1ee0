// Alpha texels of a block's fragments: multiplication of sigma, and the mark in v.
#pragma once

#include <algorithm>

#include "core/kernel.h"
#include "cpu/simd.h"
#include "ops/texel_alpha.h"

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

// Prefetches the tile entry of a surfel a few steps ahead, the texels of the next surfel, and their gradients
// `of_texels`, unless null.
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

}  // namespace bt
