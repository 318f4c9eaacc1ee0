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
        right_(size_[0] > 1 ? 1 : 0),
        down_(size_[1] > 1 ? size_[0] : 0) {}
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
      m[i] = mix(i);
    }
    return load(m);
  }
  // Adds to the texels' gradients [of all tiles] and to those of u and v, from gradients g of the lanes' alphas.
  void add_gradient(uint32_t lanes, const S* g, S* texels, S* du, S* dv) const {
    for (; lanes; lanes &= lanes - 1) {
      const int i = __builtin_ctz(lanes);
      const S *t = tile_ + at_[i], fx = fx_[i], fy = fy_[i];
      if (texels) {
        S w[4], *to = texels + first_ + at_[i];
        texel_weights(fx, fy, w);
        to[0] += w[0] * g[i], to[right_] += w[1] * g[i], to[down_] += w[2] * g[i], to[down_ + right_] += w[3] * g[i];
      }
      const S four[4] = {t[0], t[right_], t[down_], t[down_ + right_]};
      if (inside_u_ >> i & 1) du[i] += g[i] * texel_density(size_[0], extent_) * texel_slope_u(four, fy);
      if (inside_v_ >> i & 1) dv[i] += g[i] * texel_density(size_[1], extent_) * texel_slope_v(four, fx);
    }
  }

 private:
  static constexpr int32_t kNone[2] = {0, 0};
  S mix(int i) const {
    const S *t = tile_ + at_[i], fx = fx_[i], fy = fy_[i];
    const S above = t[0] + fx * (t[right_] - t[0]);
    const S below = t[down_] + fx * (t[down_ + right_] - t[down_]);
    return above + fy * (below - above);
  }
  const int32_t* size_;
  int64_t first_;
  S extent_;
  const S* tile_;
  int right_, down_;
  int32_t at_[kLanes];
  S fx_[kLanes], fy_[kLanes];
  uint32_t inside_u_ = 0, inside_v_ = 0;
};

}  // namespace bt
