// Alpha texels under the fragments of one surfel.
#pragma once

#include "cpu/blocks.h"
#include "ops/visibility.h"

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

template <class S> class AlphaPatch {
 public:
  using P = Lanes<S>;
  AlphaPatch(const AlphaTiles<S>& tiles, int64_t id)
      : size_(tiles.values ? tiles.size + 2 * id : kNone),
        first_(tiles.values ? tiles.first[id] : 0),
        extent_(tiles.values ? tiles.extent[id] : S(1)),
        tile_(tiles.values ? tiles.values + first_ : nullptr),
        next_(size_) {}
  bool textured() const { return size_[0] > 0; }

  // Computes the texel positions of a block's fragments.
  void locate(P u, P v) {
    const TexelAxis<P> x = texel_axis(u, size_[0], extent_), y = texel_axis(v, size_[1], extent_);
    store_integers(at_, y.first * P(S(size_[0])) + x.first);
    store(fx_, x.fraction), store(fy_, y.fraction);
    inside_u_ = bits(x.inside), inside_v_ = bits(y.inside);
  }
  // Their alpha in `lanes`, 1 in others.
  P fetch(uint32_t lanes) const {
    S m[kLanes];
    std::fill(m, m + kLanes, S(1));
    for (; lanes; lanes &= lanes - 1) {
      const int i = __builtin_ctz(lanes);
      S t[4];
      load_four(i, t);
      m[i] = texel_lerp(t, fx_[i], fy_[i]);
    }
    return load(m);
  }
  // Adds to the texels' gradients [of all tiles] and to those of u and v, from gradients g of the lanes' alphas.
  void add_gradient(uint32_t lanes, const S* g, S* texels, S* du, S* dv) const {
    for (; lanes; lanes &= lanes - 1) {
      const int i = __builtin_ctz(lanes);
      if (texels) {
        S w[4], *to = texels + first_ + at_[i];
        texel_weights(fx_[i], fy_[i], w);
        for (int k = 0; k < 4; ++k) to[offset(k)] += w[k] * g[i];
      }
      S t[4];
      load_four(i, t);
      if (inside_u_ >> i & 1) du[i] += g[i] * texel_density(size_[0], extent_) * texel_slope_u(t, fy_[i]);
      if (inside_v_ >> i & 1) dv[i] += g[i] * texel_density(size_[1], extent_) * texel_slope_v(t, fx_[i]);
    }
  }

 private:
  static constexpr int32_t kNone[2] = {0, 0};
  // Of corner k of a fetch from its first.
  int offset(int k) const { return (k & 1 ? next_.right : 0) + (k & 2 ? next_.down : 0); }
  void load_four(int i, S* t) const {
    for (int k = 0; k < 4; ++k) t[k] = tile_[at_[i] + offset(k)];
  }
  const int32_t* size_;
  int64_t first_;
  S extent_;
  const S* tile_;
  TexelSteps next_;
  int32_t at_[kLanes];
  S fx_[kLanes], fy_[kLanes];
  uint32_t inside_u_ = 0, inside_v_ = 0;
};

}  // namespace bt
