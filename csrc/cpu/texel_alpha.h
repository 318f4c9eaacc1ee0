// Alpha texels under the fragments of a block: the cut of their sigma, and the mark in their v.
#pragma once

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

// fn(lane) for a set of lanes.
template <class F> void each_lane(uint32_t lanes, F&& fn) {
  for (; lanes; lanes &= lanes - 1) fn(__builtin_ctz(lanes));
}
// The sigma of a block's fragments, multiplied by alpha where the weight reaches the bound, and the mark.
template <class S>
void cut(const AlphaTiles<S>& tiles, int64_t id, const typename Lanes<S>::M& covered, Lanes<S> transmittance,
         Fragment<Lanes<S>>& f) {
  const AlphaPatch<S> patch(tiles, id);
  if (!patch.textured()) return;
  const uint32_t lanes = bits(covered & (blend(f.sigma, transmittance).weight >= Lanes<S>(tiles.bound)));
  f.v = marked(f.v, lanes);
  if (!lanes) return;
  S u[kLanes], v[kLanes], sigma[kLanes], t[4];
  store(u, f.u), store(v, f.v), store(sigma, f.sigma);
  each_lane(lanes, [&](int i) { sigma[i] = alpha_cut(sigma[i], patch.fetch(patch.corners(u[i], v[i]), t)); });
  f.sigma = load(sigma);
}

}  // namespace bt
