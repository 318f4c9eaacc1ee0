// Alpha texels under the fragments of a block: the cut of their sigma, and the mark in their v.
#pragma once

#include <algorithm>

#include "core/prefilter.h"
#include "cpu/simd.h"
#include "ops/texel_alpha.h"

namespace bt {

// Fragments whose sigma was multiplied, as the last bit of their v.
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

// Prefetches where the tile of a surfel lies that comes later, and what most tiles have of one that comes soon; also of
// the gradients `of_texels`, null: there are none.
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
// The alpha texels under some of a block's fragments, 1 under others.
template <class S> class AlphaLanes {
 public:
  using P = Lanes<S>;
  AlphaLanes(const AlphaPatch<S>& patch, P u, P v, uint32_t lanes)
      : lanes_(lanes),
        patch_(patch),
        x_(texel_axis(u, patch.size[0], patch.extent)),
        y_(texel_axis(v, patch.size[1], patch.extent)) {
    S t[4][kLanes];
    for (auto& corner : t) store(corner, P(S(1)));
    store_integers(first_, y_.first * P(S(patch.size[0])) + x_.first);
    each_corner([&](int lane, int corner, int32_t at) { t[corner][lane] = patch.tile[at]; });
    for (int k = 0; k < 4; ++k) t_[k] = load(t[k]);
  }
  P sigma(P uncut) const {
    return select(mask_of<S>(lanes_), alpha_cut(uncut, texel_lerp(t_, x_.fraction, y_.fraction)), uncut);
  }
  // See alpha_vjp. Adds the gradients of the texels to those of their tile, null: there are none.
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
    each_corner([&](int lane, int corner, int32_t at) { to[at] += by_corner[corner][lane]; });
  }

 private:
  // fn(lane, corner, texel)
  template <class F> BT_HD void each_corner(F&& fn) const {
    const TexelSteps next(patch_.size);
    each_lane(lanes_, [&](int lane) {
      const int32_t at = first_[lane], below = at + next.down;
      fn(lane, 0, at), fn(lane, 1, at + next.right), fn(lane, 2, below), fn(lane, 3, below + next.right);
    });
  }

  uint32_t lanes_;
  const AlphaPatch<S>& patch_;
  TexelAxis<P> x_, y_;
  int32_t first_[kLanes];
  P t_[4];
};
// The sigma of a block's fragments, multiplied by alpha where the weight reaches the bound, and the mark.
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
