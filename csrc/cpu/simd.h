// 16 lanes on the compiler's vector extensions, with the functions that core/ needs of a real.
#pragma once

#include <array>
#include <cstring>
#include <limits>
#include <type_traits>

#include "core/common.h"
#include "core/field.h"
#include "cpu/wide.h"

namespace bt {

// Calls fn(lane) for a set of lanes.
template <class F> BT_HD void each_lane(uint32_t lanes, F&& fn) {
  for (; lanes; lanes &= lanes - 1) fn(__builtin_ctz(lanes));
}
// Builds the mask of the lanes with a bit in `lanes`.
template <class M> BT_HD M mask_of_lanes(uint32_t lanes) {
  if constexpr (is_two<M>) {
    constexpr int n = sizeof(M::low) / sizeof(typename M::Lane);
    return {mask_of_lanes<decltype(M::low)>(lanes), mask_of_lanes<decltype(M::high)>(lanes >> n)};
  } else {
    M r;
    for (size_t i = 0; i < sizeof r / sizeof r[0]; ++i) r[i] = lanes >> i & 1 ? -1 : 0;
    return r;
  }
}

#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <> BT_HD MaskOfFloats mask_of_lanes(uint32_t lanes) { return {__mmask16(lanes)}; }
BT_HD __mmask16 first_lanes(uint32_t lanes) { return __mmask16((1u << __builtin_popcount(lanes)) - 1u); }

// Stores the selected lanes contiguously; `to` has room for all lanes of `a`.
BT_HD void compress_lanes(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm512_storeu_ps(to, _mm512_maskz_compress_ps(__mmask16(lanes), (__m512)a));
}
BT_HD void compress_lanes(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(lanes), (__m512i)a));
}
// Stores the selected lanes without writing beyond them.
BT_HD void compress_lanes_only(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm512_mask_storeu_ps(to, first_lanes(lanes), _mm512_maskz_compress_ps(__mmask16(lanes), (__m512)a));
}
BT_HD void compress_lanes_only(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  _mm512_mask_storeu_epi32(to, first_lanes(lanes), _mm512_maskz_compress_epi32(__mmask16(lanes), (__m512i)a));
}
// Loads contiguous memory into the selected lanes, others 0, without reading beyond.
BT_HD void expand_lanes(const float* from, Vector<float>& to, uint32_t lanes) {
  to = (Vector<float>)_mm512_maskz_expand_ps(__mmask16(lanes), _mm512_maskz_loadu_ps(first_lanes(lanes), from));
}
#elif defined(__AVX2__)
BT_HD __m256i mask_of_eight(uint32_t lanes) {
  const __m256i bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
  return _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(int(lanes)), bit), bit);
}
template <> BT_HD MaskOfFloats mask_of_lanes(uint32_t lanes) { return (MaskOfFloats)mask_of_eight(lanes); }
BT_HD __m256i first_lanes(uint32_t lanes) { return mask_of_eight((1u << __builtin_popcount(lanes)) - 1u); }

// Permutations per set of eight lanes, a byte per lane: the selected lanes in order, and the rank of each lane.
struct LaneOrder {
  std::array<uint64_t, 256> number{}, rank{};
  constexpr LaneOrder() {
    for (int set = 0; set < 256; ++set)
      for (int lane = 0, n = 0; lane < 8; ++lane) {
        rank[set] |= uint64_t(n) << 8 * lane;
        if (set >> lane & 1) number[set] |= uint64_t(lane) << 8 * n++;
      }
  }
};
inline constexpr LaneOrder kLaneOrder;
BT_HD __m256i lane_numbers(uint64_t order) { return _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(int64_t(order))); }
BT_HD __m256 permuted(__m256 a, uint64_t order) { return _mm256_permutevar8x32_ps(a, lane_numbers(order)); }
BT_HD void compress_lanes(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm256_storeu_ps(to, permuted((__m256)a, kLaneOrder.number[lanes]));
}
BT_HD void compress_lanes(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  compress_lanes((float*)to, (Vector<float>)a, lanes);
}
BT_HD void compress_lanes_only(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm256_maskstore_ps(to, first_lanes(lanes), permuted((__m256)a, kLaneOrder.number[lanes]));
}
BT_HD void compress_lanes_only(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  const __m256i next = _mm256_permutevar8x32_epi32((__m256i)a, lane_numbers(kLaneOrder.number[lanes]));
  _mm256_maskstore_epi32(to, first_lanes(lanes), next);
}
BT_HD void expand_lanes(const float* from, Vector<float>& to, uint32_t lanes) {
  const __m256 all = permuted(_mm256_maskload_ps(from, first_lanes(lanes)), kLaneOrder.rank[lanes]);
  to = (Vector<float>)_mm256_and_ps(all, _mm256_castsi256_ps(mask_of_eight(lanes)));
}
#endif

// Calls fn(lanes of the lower half, of the upper half, number in the lower half).
template <class V, class F> BT_HD void by_halves(uint32_t lanes, F&& fn) {
  constexpr int n = sizeof(V::low) / sizeof(typename V::Lane);
  const uint32_t low = lanes & ((1u << n) - 1u);
  fn(low, lanes >> n, __builtin_popcount(low));
}
template <class T, class V> BT_HD void compress_lanes_only(T* to, const V& a, uint32_t lanes) {
  if constexpr (is_two<V>) {
    by_halves<V>(lanes, [&](uint32_t low, uint32_t high, int n) {
      compress_lanes_only(to, a.low, low), compress_lanes_only(to + n, a.high, high);
    });
  } else {
    for (uint32_t k = lanes; k; k &= k - 1) *to++ = a[__builtin_ctz(k)];
  }
}
template <class T, class V> BT_HD void compress_lanes(T* to, const V& a, uint32_t lanes) {
  if constexpr (is_two<V>)
    by_halves<V>(lanes, [&](uint32_t low, uint32_t high, int n) {
      compress_lanes(to, a.low, low), compress_lanes(to + n, a.high, high);
    });
  else
    compress_lanes_only(to, a, lanes);
}
template <class T, class V> BT_HD void expand_lanes(const T* from, V& to, uint32_t lanes) {
  if constexpr (is_two<V>) {
    by_halves<V>(lanes, [&](uint32_t low, uint32_t high, int n) {
      expand_lanes(from, to.low, low), expand_lanes(from + n, to.high, high);
    });
  } else {
    to = V{};
    for (uint32_t k = lanes; k; k &= k - 1) to[__builtin_ctz(k)] = *from++;
  }
}

template <class S> struct Lanes;

// Spelt out per scalar: the compiler drops the vector attribute of dependent types.
template <class S> struct LaneTypes;
template <> struct LaneTypes<float> {
  using M = decltype(above(Wide<float>{}, Wide<float>{}));
  using I = Wide<int32_t>;
  using U = Wide<uint32_t>;
  typedef float O __attribute__((vector_size(32)));
  typedef float Q __attribute__((vector_size(16)));
};
template <> struct LaneTypes<double> {
  using M = decltype(above(Wide<double>{}, Wide<double>{}));
  using I = Wide<int64_t>;
  using U = Wide<uint64_t>;
  typedef double O __attribute__((vector_size(64)));
  typedef double Q __attribute__((vector_size(32)));
};
template <class S> using Quad = typename LaneTypes<S>::Q;  // 4 lanes: a table entry
template <class S> using Oct = typename LaneTypes<S>::O;   // 8 lanes

template <class S> struct IndexOf<Lanes<S>> {
  using type = typename LaneTypes<S>::U;
};

template <class S> struct Lanes {
  using V = Wide<S>;
  using M = typename LaneTypes<S>::M;  // a mask
  using I = typename LaneTypes<S>::I;  // integers
  V v;
  Lanes() = default;
  BT_HD Lanes(const V& value) : v(value) {}
  BT_HD explicit Lanes(S value) : v(all_lanes<V>(value)) {}
  template <class F, class = std::enable_if_t<std::is_floating_point_v<F> && !std::is_same_v<F, S>>>
  BT_HD explicit Lanes(F value) : Lanes(S(value)) {}
  BT_HD S operator[](int i) const { return v[i]; }
  BT_HD void set(int i, S value) { set_lane(v, i, value); }
};

template <class S> BT_HD Lanes<S> operator+(Lanes<S> a, Lanes<S> b) { return a.v + b.v; }
template <class S> BT_HD Lanes<S> operator-(Lanes<S> a, Lanes<S> b) { return a.v - b.v; }
template <class S> BT_HD Lanes<S> operator-(Lanes<S> a) { return -a.v; }
template <class S> BT_HD Lanes<S> operator*(Lanes<S> a, Lanes<S> b) { return a.v * b.v; }
template <class S> BT_HD Lanes<S> operator/(Lanes<S> a, Lanes<S> b) { return a.v / b.v; }
template <class S> BT_HD Lanes<S>& operator+=(Lanes<S>& a, Lanes<S> b) {
  a.v = a.v + b.v;
  return a;
}
template <class S> BT_HD Lanes<S>& operator-=(Lanes<S>& a, Lanes<S> b) {
  a.v = a.v - b.v;
  return a;
}
// Comparisons return masks, which combine with & | ~.
template <class S> BT_HD typename Lanes<S>::M operator>(Lanes<S> a, Lanes<S> b) { return above(a.v, b.v); }
template <class S> BT_HD typename Lanes<S>::M operator<(Lanes<S> a, Lanes<S> b) { return above(b.v, a.v); }
template <class S> BT_HD typename Lanes<S>::M operator>=(Lanes<S> a, Lanes<S> b) { return at_least(a.v, b.v); }
BT_HD LaneTypes<float>::M not_(const LaneTypes<float>::M& m) { return ~m; }
BT_HD LaneTypes<double>::M not_(const LaneTypes<double>::M& m) { return ~m; }
BT_HD bool any_(const LaneTypes<float>::M& m) { return bits(m) != 0; }
BT_HD bool any_(const LaneTypes<double>::M& m) { return bits(m) != 0; }
template <class S> BT_HD Lanes<S> select(typename Lanes<S>::M m, Lanes<S> yes, Lanes<S> no) {
  return choose(m, yes.v, no.v);
}
template <class S> BT_HD Vec3<Lanes<S>> select(typename Lanes<S>::M m, Vec3<Lanes<S>> yes, Vec3<Lanes<S>> no) {
  return {select(m, yes.x, no.x), select(m, yes.y, no.y), select(m, yes.z, no.z)};
}
template <class S> BT_HD Lanes<S> max_(Lanes<S> a, Lanes<S> b) { return larger(a.v, b.v); }
template <class S> BT_HD Lanes<S> min_(Lanes<S> a, Lanes<S> b) { return smaller(a.v, b.v); }

template <class S> BT_HD Lanes<S> relu(Lanes<S> a) {
  return larger(Lanes<S>(S(0)).v, a.v);  // keeps NaN
}

// exp and log of floats, below 2 ulp over the normal range: Cody-Waite reduction and a minimax polynomial in pairs, for
// short dependency chains.
BT_HD Lanes<float> exp_(Lanes<float> x) {
  using V = Lanes<float>::V;
  using I = Lanes<float>::I;
  V a = min_(max_(x, Lanes<float>(-87.0f)), Lanes<float>(88.0f)).v;
  const V magic = Lanes<float>(12582912.0f).v;  // 1.5 * 2^23: adding it rounds to an integer
  const V n = (a * 1.44269504f + magic) - magic;
  const V f = (a - n * 0.693145752f) - n * 1.42860677e-6f, f2 = f * f;
  // exp(f) = 1 + f + f^2 q
  const V q = (0.166665211f * f + 0.49999994f) + f2 * ((8.36871658e-3f * f + 4.16683890e-2f) + f2 * 1.38145988e-3f);
  const V p = (1.0f + f) + f2 * q;
  const V two_n = same_bits<V>((convert<I>(n) + 127) << 23);
  return choose(x.v < -87.0f, V{}, p * two_n);
}
BT_HD Lanes<float> log_(Lanes<float> x) {
  using V = Lanes<float>::V;
  using I = Lanes<float>::I;
  const I bits = same_bits<I>(x.v);
  // mantissa in [sqrt(1/2), sqrt(2)), for relative accuracy near 1
  const I shifted = bits - 0x3f3504f3;
  const I e = shifted >> 23;
  const V m = same_bits<V>((shifted & 0x007fffff) + 0x3f3504f3);
  const V f = m - 1.0f, f2 = f * f, f4 = f2 * f2;
  // log(1 + f) = f - f^2 / 2 + f^3 q
  const V low = (-0.250013381f * f + 0.333339095f) + f2 * (-0.16577585f * f + 0.199630633f);
  const V q = low + f4 * ((-0.142674878f * f + 0.149147674f) + f2 * 8.70043784e-2f);
  const V r = f + f2 * (f * q - 0.5f);
  const V n = convert<V>(e);
  return (r + n * 1.42860677e-6f) + n * 0.693145752f;
}
// x^y for x in (0, 1] and y >= 0, to base 2, with a relative error below 1e-6 where the result exceeds 1e-3: as
// accurate as exp_ of y log_(x) in half the operations; at least 2^-126, as denormals are slow.
#if defined(__AVX512F__) && defined(__AVX512DQ__)
// 1 / m and -log2 of it, at the middles of 16 parts of [1, 2)
alignas(64) inline constexpr float kInverse[16] = {
    0.969696999f, 0.914285719f, 0.864864886f, 0.820512831f, 0.780487776f, 0.744186044f, 0.711111128f, 0.680851042f,
    0.653061211f, 0.627451003f, 0.603773594f, 0.581818163f, 0.561403513f, 0.542372882f, 0.524590135f, 0.507936537f};
alignas(64) inline constexpr float kLogarithm[16] = {
    0.0443940759f, 0.129283011f, 0.209453329f, 0.285402209f, 0.357552052f, 0.426264763f, 0.491853058f, 0.554588914f,
    0.614709854f,  0.67242527f,  0.727920413f, 0.781359732f, 0.832889974f, 0.882643044f, 0.930737436f, 0.977279842f};
BT_HD Lanes<float> power_(Lanes<float> x, Lanes<float> y) {
  constexpr __mmask16 kAll = 0xffff;
  using V = Lanes<float>::V;
  const __m512 m = _mm512_maskz_getmant_ps(kAll, (__m512)x.v, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_src);
  const __m512i part = _mm512_maskz_srli_epi32(kAll, (__m512i)m, 19);  // the permutation uses its low four bits
  const V c = (V)_mm512_maskz_permutexvar_ps(kAll, part, _mm512_load_ps(kInverse));
  const V l = (V)_mm512_maskz_permutexvar_ps(kAll, part, _mm512_load_ps(kLogarithm));
  const V r = (V)m * c - 1.0f;
  const V q = (0.481303573f * r - 0.721644163f) * r + 1.4426949f;
  const V a = larger(y.v * ((V)_mm512_maskz_getexp_ps(kAll, (__m512)x.v) + (r * q + l)), Lanes<float>(-126.0f).v);
  const V n = (V)_mm512_maskz_roundscale_ps(kAll, (__m512)a, _MM_FROUND_TO_NEAREST_INT);
  const V f = a - n, f2 = f * f;
  const V p = (0.693147004f + 0.240222424f * f) + f2 * ((5.55073358e-2f + 9.67151299e-3f * f) + f2 * 1.32647273e-3f);
  return (V)_mm512_maskz_scalef_ps(kAll, (__m512)(f * p + 1.0f), (__m512)n);
}
#else
// In halves: a whole vector would exceed the registers.
template <class V> BT_HD V power_of(const V& x, const V& y) {
  if constexpr (is_two<V>) {
    return {power_of(x.low, y.low), power_of(x.high, y.high)};
  } else {
    using I = Vector<int32_t>;
    const I shifted = same_bits<I>(x) - 0x3f3504f3;
    // mantissa - 1, for mantissas in [sqrt(1/2), sqrt(2))
    const V r = same_bits<V>((shifted & 0x007fffff) + 0x3f3504f3) - 1.0f, r2 = r * r;
    const V low = (1.44269478f - 0.721357167f * r) + r2 * (0.480939448f - 0.360087216f * r);
    const V high = (0.286707461f - 0.250069052f * r) + r2 * (0.23689033f - 0.145744368f * r);
    const V a = larger(y * (convert<V>(shifted >> 23) + r * (low + (r2 * r2) * high)), all_lanes<V>(-126.0f));
    const V magic = all_lanes<V>(12582912.0f), moved = a + magic;  // as in exp_
    const V f = a - (moved - magic), f2 = f * f;
    const V p = (0.693147004f + 0.240222424f * f) + f2 * ((5.55073358e-2f + 9.67151299e-3f * f) + f2 * 1.32647273e-3f);
    return same_bits<V>(same_bits<I>(f * p + 1.0f) + (same_bits<I>(moved) << 23));
  }
}
BT_HD Lanes<float> power_(Lanes<float> x, Lanes<float> y) { return power_of(x.v, y.v); }
#endif
BT_HD Lanes<double> exp_(Lanes<double> x) {
  Lanes<double> r;
  for (int i = 0; i < kLanes; ++i) r.set(i, std::exp(x[i]));
  return r;
}
BT_HD Lanes<double> log_(Lanes<double> x) {
  Lanes<double> r;
  for (int i = 0; i < kLanes; ++i) r.set(i, std::log(x[i]));
  return r;
}

BT_HD Lanes<double> widened(Lanes<float> a) { return all_widened(a.v); }
BT_HD Lanes<double> widened(Lanes<double> a) { return a; }
template <class T> BT_HD T narrowed(Lanes<double> a) {
  if constexpr (std::is_same_v<T, Lanes<float>>)
    return all_narrowed(a.v);
  else
    return a;
}
template <class S> BT_HD typename Lanes<S>::M finite_(Lanes<S> a) {
  return abs_(a) < Lanes<S>(std::numeric_limits<S>::infinity());  // false for NaN
}

template <class S> BT_HD typename Lanes<S>::M mask_of(uint32_t lanes) {
  return mask_of_lanes<typename Lanes<S>::M>(lanes);
}
template <class S> BT_HD void compress(S* to, Lanes<S> a, uint32_t lanes) { compress_lanes(to, a.v, lanes); }
BT_HD void compress(int32_t* to, const Wide<int32_t>& a, uint32_t lanes) { compress_lanes(to, a, lanes); }
template <class S> BT_HD void compress_only(S* to, Lanes<S> a, uint32_t lanes) { compress_lanes_only(to, a.v, lanes); }
BT_HD void compress_only(int32_t* to, const Wide<int32_t>& a, uint32_t lanes) { compress_lanes_only(to, a, lanes); }
// Stores selected lanes where memory up to `end` is written later anyway: masked stores are slow on AMD.
template <class T, class V> BT_HD void compress_until(T* end, T* to, const V& a, uint32_t lanes) {
  end - to >= kLanes ? compress(to, a, lanes) : compress_only(to, a, lanes);
}
template <class S> BT_HD Lanes<S> expand(const S* from, uint32_t lanes) {
  Lanes<S> r;
  expand_lanes(from, r.v, lanes);
  return r;
}

template <class S> BT_HD Lanes<S> load(const S* p) { return load_vector<typename Lanes<S>::V>(p); }
template <class S> BT_HD void store(S* p, Lanes<S> a) { store_vector(p, a.v); }
template <class S> BT_HD Lanes<S> sqrt_(Lanes<S> a) { return square_root(a.v); }
template <class S> BT_HD Lanes<S> floor_(Lanes<S> a) { return round_down(a.v); }
template <class S> BT_HD typename IndexOf<Lanes<S>>::type to_index(Lanes<S> a) {
  return same_bits<typename IndexOf<Lanes<S>>::type>(convert<typename Lanes<S>::I>(a.v));
}
// Converts integers below 2^24 to lanes, and back.
template <class S> BT_HD Lanes<S> from_integers(const Wide<uint32_t>& a) {
  if constexpr (std::is_same_v<S, float>) return convert<Wide<float>>(same_bits<Wide<int32_t>>(a));
  Lanes<S> r;
  for (int i = 0; i < kLanes; ++i) r.set(i, S(a[i]));
  return r;
}
template <class S> BT_HD void store_integers(int32_t* to, Lanes<S> a) {
  const auto whole = to_index(a);
  if constexpr (std::is_same_v<S, float>)
    std::memcpy(to, &whole, sizeof whole);
  else
    for (int i = 0; i < kLanes; ++i) to[i] = int32_t(whole[i]);
}
// Returns half of a vector: lower (0) or upper (1). GCC has the shuffle since version 12.
template <int which, class Half, class V> BT_HD Half half(V v) {
  static_assert(sizeof(V) == 2 * sizeof(Half));
#if __has_builtin(__builtin_shufflevector)
  constexpr int n = sizeof(Half) / sizeof(v[0]), i = which * n;
  if constexpr (n == 4)
    return __builtin_shufflevector(v, v, i, i + 1, i + 2, i + 3);
  else
    return __builtin_shufflevector(v, v, i, i + 1, i + 2, i + 3, i + 4, i + 5, i + 6, i + 7);
#else
  Half r;
  std::memcpy(&r, reinterpret_cast<const char*>(&v) + which * sizeof r, sizeof r);
  return r;
#endif
}
// Folds the lanes to four by adding halves.
template <class S, class V> BT_HD Quad<S> folded(const V& v) {
  if constexpr (std::is_same_v<V, Quad<S>>)
    return v;
  else if constexpr (is_two<V>)
    return folded<S>(v.low + v.high);
  else if constexpr (std::is_same_v<V, Oct<S>>)
    return half<0, Quad<S>>(v) + half<1, Quad<S>>(v);
  else
    return folded<S>(half<0, Oct<S>>(v) + half<1, Oct<S>>(v));
}
template <class S> BT_HD S sum(Lanes<S> a) {
  const Quad<S> q = folded<S>(a.v);
  return (q[0] + q[2]) + (q[1] + q[3]);
}

}  // namespace bt
