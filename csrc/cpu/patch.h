// The texels under fragments of one surfel: their places for many fragments at a time, their colours as vectors of
// four.
#pragma once

#include <algorithm>

#include "cpu/simd.h"
#include "ops/texel.h"

namespace bt {

// A colour and a fourth number, with the functions that core/ expects of a real.
template <class S>
struct Four {
  Quad<S> v;
  Four() = default;
  BT_HD Four(const Quad<S>& value) : v(value) {}
  BT_HD explicit Four(S value) : v(value - Quad<S>{}) {}
  template <class F, class = std::enable_if_t<std::is_floating_point_v<F> && !std::is_same_v<F, S>>>
  BT_HD explicit Four(F value) : Four(S(value)) {}
  BT_HD Four(Vec3<S> a, S last) : v{a.x, a.y, a.z, last} {}
  BT_HD Vec3<S> three() const { return {v[0], v[1], v[2]}; }
  BT_HD static Four load(const S* p) {
    Four r;
    std::memcpy(&r.v, p, sizeof r.v);
    return r;
  }
  // Three numbers and a 0: what lies behind them is not read.
  BT_HD static Four load_three(const S* p) {
#if defined(__AVX__)
    if constexpr (std::is_same_v<S, float>)
      return {(Quad<S>)_mm_maskload_ps(p, _mm_setr_epi32(-1, -1, -1, 0))};
    else
#endif
      return {load3(p), S(0)};
  }
  BT_HD void store(S* p) const { std::memcpy(p, &v, sizeof v); }
};
template <class S>
BT_HD Four<S> operator+(Four<S> a, Four<S> b) {
  return a.v + b.v;
}
template <class S>
BT_HD Four<S> operator-(Four<S> a, Four<S> b) {
  return a.v - b.v;
}
template <class S>
BT_HD Four<S> operator*(S k, Four<S> a) {
  return k * a.v;
}
template <class S>
BT_HD auto operator<(Four<S> a, Four<S> b) {
  return a.v < b.v;
}
template <class S>
BT_HD auto operator>(Four<S> a, Four<S> b) {
  return a.v > b.v;
}
template <class S>
BT_HD Four<S> select(decltype(Quad<S>{} > Quad<S>{}) m, Four<S> yes, Four<S> no) {
  return m ? yes.v : no.v;
}
template <class S>
BT_HD S dot(Four<S> a, Four<S> b) {
  const Quad<S> p = a.v * b.v;
  return (p[0] + p[2]) + (p[1] + p[3]);
}
template <class S>
BT_HD Four<S> without_last(Four<S> a) {
  a.v[3] = S(0);
  return a;
}
// Up to so many fragments of a surfel that follow each other in the list.
constexpr int kFew = 64;

// Which of them show a texel, and which do not.
struct Textured {
  int count = 0, others = 0;
  uint8_t at[kFew], other[kFew];

  template <class S>
  Textured(const S* weight, int fragments, S bound) {
    for (int j = 0; j < fragments; ++j) {
      const bool shows = weight[j] >= bound;  // without a branch, which would be guessed wrongly
      at[count] = other[others] = uint8_t(j);
      count += shows, others += !shows;
    }
  }
};

// The texels of one of them, each beside a 0, and their weights.
template <class S>
struct TexelFours {
  Four<S> t[4];
  S weight[4];
  BT_HD Four<S> mix() const { return texel_mix(t, weight); }
};

// Up to kFew fragments of a surfel that has a tile.
template <class S>
class PatchFragments {
 public:
  BT_HD explicit PatchFragments(const TexelPatch<S>& of)
      : of_(of),
        next_(of.size),
        per_u_(texel_density(of.size[0], of.extent)),
        per_v_(texel_density(of.size[1], of.extent)) {}

  // Looks where fragments at u [count], v [count] lie.
  BT_HD void look(const S* u, const S* v, int count) {
    static_assert(kFew % kLanes == 0);
    for (int j = 0; j < count; j += kLanes) {
      const int n = std::min(count - j, kLanes);
      const TexelAxis<Pack<S>> x = texel_axis(some(u + j, n), of_.size[0], of_.extent);
      const TexelAxis<Pack<S>> y = texel_axis(some(v + j, n), of_.size[1], of_.extent);
      store_integers(first_ + j, y.first * Pack<S>(S(of_.size[0])) + x.first);
      store(fx_ + j, x.fraction), store(fy_ + j, y.fraction);
      inside_u_[j / kLanes] = bits(x.inside), inside_v_[j / kLanes] = bits(y.inside);
    }
  }

  // The texels of fragment j.
  BT_HD TexelFours<S> texels(int j) const {
    TexelFours<S> q;
    const S* t = of_.tile + 3 * int64_t(first_[j]);
    const int right = 3 * next_.right, down = 3 * next_.down;
    q.t[0] = Four<S>::load_three(t), q.t[1] = Four<S>::load_three(t + right);
    q.t[2] = Four<S>::load_three(t + down), q.t[3] = Four<S>::load_three(t + down + right);
    texel_weights(fx_[j], fy_[j], q.weight);
    return q;
  }
  // Adds the gradients of its texels to rows of four, g that of its colour.
  BT_HD void add_gradient(int j, const TexelFours<S>& q, Four<S> g, S* rows) const {
    S* at = rows + 4 * int64_t(first_[j]);
    const int offset[4] = {0, 4 * next_.right, 4 * next_.down, 4 * (next_.down + next_.right)};
    for (int k = 0; k < 4; ++k) (Four<S>::load(at + offset[k]) + q.weight[k] * g).store(at + offset[k]);
  }
  // Of its coordinates; see texel_slopes.
  BT_HD S gradient_u(int j, const TexelFours<S>& q, Four<S> g) const {
    return inside_u_[j / kLanes] >> j % kLanes & 1 ? per_u_ * dot(g, texel_slope_u(q.t, fy_[j])) : S(0);
  }
  BT_HD S gradient_v(int j, const TexelFours<S>& q, Four<S> g) const {
    return inside_v_[j / kLanes] >> j % kLanes & 1 ? per_v_ * dot(g, texel_slope_v(q.t, fx_[j])) : S(0);
  }

 private:
  BT_HD static Pack<S> some(const S* p, int n) {
    if (n == kLanes) return load(p);
    S all[kLanes] = {};
    std::memcpy(all, p, n * sizeof(S));
    return load(all);
  }

  const TexelPatch<S>& of_;
  TexelSteps next_;
  S per_u_, per_v_;
  int32_t first_[kFew];
  S fx_[kFew], fy_[kFew];
  uint32_t inside_u_[kFew / kLanes], inside_v_[kFew / kLanes];
};

}  // namespace bt
