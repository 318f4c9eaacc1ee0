// The texels under fragments of one surfel: their positions for many fragments at a time, their colours as vectors of
// four.
#pragma once

#include "cpu/blocks.h"
#include "ops/texel.h"

namespace bt {

// A colour and a fourth number, with the functions that core/ expects of a real.
template <class S> struct Four {
  Quad<S> v;
  Four() = default;
  BT_HD Four(const Quad<S>& value) : v(value) {}
  BT_HD explicit Four(S value) : v(value - Quad<S>{}) {}
  template <class F, class = std::enable_if_t<std::is_floating_point_v<F> && !std::is_same_v<F, S>>>
  BT_HD explicit Four(F value) : Four(S(value)) {}
  BT_HD Four(Vec3<S> a, S last) : v{a.x, a.y, a.z, last} {}
  BT_HD static Four load(const S* p) {
    Four r;
    std::memcpy(&r.v, p, sizeof r.v);
    return r;
  }
  BT_HD void store(S* p) const { std::memcpy(p, &v, sizeof v); }
};
template <class S> BT_HD Four<S> operator+(Four<S> a, Four<S> b) { return a.v + b.v; }
template <class S> BT_HD Four<S> operator-(Four<S> a, Four<S> b) { return a.v - b.v; }
template <class S> BT_HD Four<S> operator*(S k, Four<S> a) { return k * a.v; }
template <class S> BT_HD auto operator<(Four<S> a, Four<S> b) { return a.v < b.v; }
template <class S> BT_HD Four<S> select(decltype(Quad<S>{} > Quad<S>{}) m, Four<S> yes, Four<S> no) {
  return m ? yes.v : no.v;
}
template <class S> BT_HD S dot(Four<S> a, Four<S> b) {
  const Quad<S> p = a.v * b.v;
  return (p[0] + p[2]) + (p[1] + p[3]);
}

// Up to so many fragments: those of a surfel in the blocks of a tile.
constexpr int kFew = kBlocks * kLanes;

// Two texels side by side: their six numbers, or one's, and 0.
template <class S> BT_HD Oct<S> load_two(const S* p, bool both) {
#if defined(__AVX2__)
  if constexpr (std::is_same_v<S, float>) {
    const int right = both ? -1 : 0;
    return (Oct<S>)_mm256_maskload_ps(p, _mm256_setr_epi32(-1, -1, -1, right, right, right, 0, 0));
  }
#endif
  Oct<S> r = {};
  std::memcpy(&r, p, (both ? 6 : 3) * sizeof(S));
  return r;
}

// Up to kFew fragments of a surfel that has texels.
template <class S> class PatchFragments {
 public:
  BT_HD explicit PatchFragments(const TexelPatch<S>& of)
      : of_(of),
        next_(of.size),
        per_u_(texel_density(of.size[0], of.extent)),
        per_v_(texel_density(of.size[1], of.extent)) {}

  // Computes the texel positions of a block's fragments, numbered from j on by lane.
  BT_HD void locate(int j, Lanes<S> u, Lanes<S> v) {
    const TexelAxis<Lanes<S>> x = texel_axis(u, of_.size[0], of_.extent), y = texel_axis(v, of_.size[1], of_.extent);
    store_integers(first_ + j, y.first * Lanes<S>(S(of_.size[0])) + x.first);
    store(fx_ + j, x.fraction), store(fy_ + j, y.fraction);
    inside_u_[j / kLanes] = bits(x.inside), inside_v_[j / kLanes] = bits(y.inside);
  }
  // Prefetches the texels of fragment j.
  BT_HD void prefetch(int j) const {
    const S* t = of_.tile + 3 * int64_t(first_[j]);
    __builtin_prefetch(t), __builtin_prefetch(t + 3 * next_.down);
  }

  // The residual of fragment j: texel_mix, of two texels at a time.
  BT_HD Four<S> residual(int j) const {
    const S *t = of_.tile + 3 * int64_t(first_[j]), fy = fy_[j];
    const bool both = next_.right;
    const Oct<S> row = (S(1) - fy) * load_two(t, both) + fy * load_two(t + 3 * next_.down, both);
    constexpr Oct<S> left = {1, 1, 1}, to_right = {-1, -1, -1, 1, 1, 1};
    const Oct<S> r = row * (left + fx_[j] * to_right);
    return half<0, Quad<S>>(r) + from_third<S>(r);
  }
  // Adds the gradients of its texels to rows of four, g that of its colour. Four at a time: a load of eight would wait
  // for the stores of the fragment before, of which it has a part.
  BT_HD void add_gradient(int j, Four<S> g, S* rows) const {
    const Four<S> below = fy_[j] * g, above = g - below, below_right = fx_[j] * below, right = fx_[j] * above;
    S* at = rows + 4 * int64_t(first_[j]);
    const int across = 4 * next_.right, down = 4 * next_.down;
    add(above - right, at), add(right, at + across);
    add(below - below_right, at + down), add(below_right, at + down + across);
  }
  // Its texels, each beside an unused number; of one column what would be to its right is 0.
  BT_HD void texels(int j, Four<S>* to) const {
    const S* t = of_.tile + 3 * int64_t(first_[j]);
    const Oct<S> above = load_two(t, next_.right), below = load_two(t + 3 * next_.down, next_.right);
    to[0] = half<0, Quad<S>>(above), to[1] = from_third<S>(above);
    to[2] = half<0, Quad<S>>(below), to[3] = from_third<S>(below);
  }
  // The gradients of its coordinates; see texel_slopes.
  BT_HD S gradient_u(int j, const Four<S>* texels, Four<S> g) const {
    return inside_u_[j / kLanes] >> j % kLanes & 1 ? per_u_ * dot(g, texel_slope_u(texels, fy_[j])) : S(0);
  }
  BT_HD S gradient_v(int j, const Four<S>* texels, Four<S> g) const {
    return inside_v_[j / kLanes] >> j % kLanes & 1 ? per_v_ * dot(g, texel_slope_v(texels, fx_[j])) : S(0);
  }

 private:
  BT_HD static void add(Four<S> a, S* to) { (Four<S>::load(to) + a).store(to); }

  const TexelPatch<S>& of_;
  TexelSteps next_;
  S per_u_, per_v_;
  int32_t first_[kFew];
  S fx_[kFew], fy_[kFew];
  uint32_t inside_u_[kFew / kLanes], inside_v_[kFew / kLanes];
};

}  // namespace bt
