// Texels of one surfel's fragments: positions and values per block, gradients as vectors of four.
#pragma once

#include "cpu/blocks.h"
#include "ops/texel.h"

namespace bt {

// A colour and a fourth number, with the functions that core/ needs of a real.
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

// Most fragments of a surfel in a tile.
constexpr int kFew = kBlocks * kLanes;

// Loads the numbers of two adjacent texels per lane, at 3 first[lane] of a tile; the left one twice unless `both`.
template <class S> BT_HD void load_pairs(const S* tile, const int32_t* first, bool both, Lanes<S>* to) {
  const auto pair = [&](int lane) { return tile + 3 * int64_t(first[lane]); };
#if defined(__AVX2__)
  if constexpr (std::is_same_v<S, float>) {
    if (both) {
      __m256 numbers[6][2];
      for (int half = 0; half < 2; ++half) {
        // four numbers of two lanes, four lanes apart
        const auto rows = [&](int lane, int number) {
          const __m128 low = _mm_loadu_ps(pair(8 * half + lane) + number);
          return _mm256_insertf128_ps(_mm256_castps128_ps256(low), _mm_loadu_ps(pair(8 * half + lane + 4) + number), 1);
        };
        const auto columns = [&](__m256 low, __m256 high, int number) {
          numbers[number][half] = _mm256_shuffle_ps(low, high, 0x44);
          numbers[number + 1][half] = _mm256_shuffle_ps(low, high, 0xee);
        };
        const __m256 a = rows(0, 0), b = rows(1, 0), c = rows(2, 0), d = rows(3, 0);
        columns(_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d), 0);
        columns(_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d), 2);
        columns(_mm256_unpackhi_ps(rows(0, 2), rows(1, 2)), _mm256_unpackhi_ps(rows(2, 2), rows(3, 2)), 4);
      }
      for (int k = 0; k < 6; ++k) to[k] = joined(numbers[k][0], numbers[k][1]);
      return;
    }
  }
#endif
  for (int lane = 0; lane < kLanes; ++lane)
    for (int k = 0; k < 6; ++k) to[k].set(lane, pair(lane)[k < 3 || both ? k : k - 3]);
}

// The four texels around each fragment of a block, interpolated along v, and the differences along v.
template <class S> struct BlockTexels {
  using P = Lanes<S>;
  P mixed[6], step[6];  // r, g, b on the left, then on the right
  P fx;

  BT_HD P residual(int c) const { return mixed[c] + fx * slope_u(c); }
  // Slopes of the bilinear fetch, per texel.
  BT_HD P slope_u(int c) const { return mixed[3 + c] - mixed[c]; }
  BT_HD P slope_v(int c) const { return step[c] + fx * (step[3 + c] - step[c]); }
};

// Up to kFew fragments of a surfel with texels.
template <class S> class PatchFragments {
 public:
  BT_HD explicit PatchFragments(const TexelPatch<S>& of)
      : of_(of),
        next_(of.size),
        per_u_(texel_density(of.size[0], of.extent)),
        per_v_(texel_density(of.size[1], of.extent)) {}

  // Computes the texel positions of a block's fragments, numbered from j by lane.
  BT_HD void locate(int j, Lanes<S> u, Lanes<S> v) {
    const TexelAxis<Lanes<S>> x = texel_axis(u, of_.size[0], of_.extent), y = texel_axis(v, of_.size[1], of_.extent);
    store_integers(first_ + j, y.first * Lanes<S>(S(of_.size[0])) + x.first);
    store(fx_ + j, x.fraction), store(fy_ + j, y.fraction);
    inside_u_[j / kLanes] = bits(x.inside), inside_v_[j / kLanes] = bits(y.inside);
  }
  BT_HD void prefetch(int j) const {
    const S* t = of_.tile + 3 * int64_t(first_[j]);
    __builtin_prefetch(t), __builtin_prefetch(t + 3 * next_.down);
  }

  // Loads the texels around the fragments of a block, numbered from j.
  BT_HD BlockTexels<S> texels(int j) const {
    BlockTexels<S> r;
    Lanes<S> below[6];
    load_pairs(of_.tile, first_ + j, next_.right, r.mixed);
    load_pairs(of_.tile + 3 * next_.down, first_ + j, next_.right, below);
    const Lanes<S> fy = load(fy_ + j);
    for (int k = 0; k < 6; ++k) r.step[k] = below[k] - r.mixed[k], r.mixed[k] += fy * r.step[k];
    r.fx = load(fx_ + j);
    return r;
  }
  // Adds the gradients of fragment j's texels to rows of four; g: gradient of its colour. Loads of eight would wait for
  // the partial stores of the previous fragment.
  BT_HD void add_gradient(int j, Four<S> g, S* rows) const {
    const Four<S> below = fy_[j] * g, above = g - below, below_right = fx_[j] * below, right = fx_[j] * above;
    S* at = rows + 4 * int64_t(first_[j]);
    const int across = 4 * next_.right, down = 4 * next_.down;
    add(above - right, at), add(right, at + across);
    add(below - below_right, at + down), add(below_right, at + down + across);
  }
  // Computes the coordinates' gradients from those of the colours, g; 0 beyond the outer texel centres.
  BT_HD Lanes<S> gradient_u(int j, const BlockTexels<S>& at, const Lanes<S>* g) const {
    const Lanes<S> slope = g[0] * at.slope_u(0) + g[1] * at.slope_u(1) + g[2] * at.slope_u(2);
    return select(mask_of<S>(inside_u_[j / kLanes]), Lanes<S>(per_u_) * slope, Lanes<S>(S(0)));
  }
  BT_HD Lanes<S> gradient_v(int j, const BlockTexels<S>& at, const Lanes<S>* g) const {
    const Lanes<S> slope = g[0] * at.slope_v(0) + g[1] * at.slope_v(1) + g[2] * at.slope_v(2);
    return select(mask_of<S>(inside_v_[j / kLanes]), Lanes<S>(per_v_) * slope, Lanes<S>(S(0)));
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
