// Vectors of 16 lanes, composed of native vectors: the compiler splits vectors wider than a register lane by lane in
// comparisons and selections.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#include "core/common.h"

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace bt {

constexpr int kLanes = 16;
#if defined(__AVX512F__) && defined(__AVX512DQ__)
constexpr int kVectorBytes = 64;
#else
constexpr int kVectorBytes = 32;
#endif

// Spelt out per scalar: the compiler drops the vector attribute of dependent types.
template <class T> struct VectorOf;
#define BT_VECTOR(T)                                           \
  template <> struct VectorOf<T> {                             \
    typedef T type __attribute__((vector_size(kVectorBytes))); \
  };
BT_VECTOR(float)
BT_VECTOR(double)
BT_VECTOR(int32_t)
BT_VECTOR(int64_t)
BT_VECTOR(uint32_t)
BT_VECTOR(uint64_t)
#undef BT_VECTOR
template <class T> using Vector = typename VectorOf<T>::type;

// Masks are lanes of 0 or -1, as the compiler makes them (its choice of 64-bit integer type varies); with AVX-512 those
// of floats are mask registers, as conversions would be frequent.
#if defined(__AVX512F__) && defined(__AVX512DQ__)
struct MaskOfFloats {
  __mmask16 m;
};
BT_HD MaskOfFloats operator&(MaskOfFloats a, MaskOfFloats b) { return {__mmask16(a.m & b.m)}; }
BT_HD MaskOfFloats operator|(MaskOfFloats a, MaskOfFloats b) { return {__mmask16(a.m | b.m)}; }
BT_HD MaskOfFloats operator~(MaskOfFloats a) { return {__mmask16(~a.m)}; }
#else
using MaskOfFloats = decltype(Vector<float>{} > Vector<float>{});
#endif
using MaskOfDoubles = decltype(Vector<double>{} > Vector<double>{});

// Two vectors, or two pairs; in memory like one vector.
template <class H> struct Two {
  H low, high;
  Two() = default;
  BT_HD Two(const H& low, const H& high) : low(low), high(high) {}
  // Explicit, as the compiler's copies are of smaller vectors, and stall later loads of whole ones.
  BT_HD Two(const Two& o) : low(o.low), high(o.high) {}
  BT_HD Two& operator=(const Two& o) {
    low = o.low, high = o.high;
    return *this;
  }
  using Lane = std::remove_const_t<std::remove_reference_t<decltype(std::declval<const H&>()[0])>>;
  BT_HD Lane operator[](int i) const {
    Lane r;
    std::memcpy(&r, reinterpret_cast<const char*>(this) + i * sizeof r, sizeof r);
    return r;
  }
};
template <class V> constexpr bool is_two = false;
template <class H> constexpr bool is_two<Two<H>> = true;

template <class T, int bytes> struct WideOf {
  using type = Two<typename WideOf<T, bytes / 2>::type>;
};
template <class T> struct WideOf<T, kVectorBytes> {
  using type = Vector<T>;
};
template <class T> using Wide = typename WideOf<T, kLanes* int(sizeof(T))>::type;

#define BT_BINARY(op)                                                            \
  template <class H> BT_HD auto operator op(const Two<H>& a, const Two<H>& b) {  \
    return Two<decltype(a.low op b.low)>{a.low op b.low, a.high op b.high};      \
  }                                                                              \
  template <class H, class A, class = std::enable_if_t<std::is_arithmetic_v<A>>> \
  BT_HD auto operator op(const Two<H>& a, A b) {                                 \
    return Two<decltype(a.low op b)>{a.low op b, a.high op b};                   \
  }                                                                              \
  template <class H, class A, class = std::enable_if_t<std::is_arithmetic_v<A>>> \
  BT_HD auto operator op(A a, const Two<H>& b) {                                 \
    return Two<decltype(a op b.low)>{a op b.low, a op b.high};                   \
  }
BT_BINARY(+)
BT_BINARY(-)
BT_BINARY(*)
BT_BINARY(/)
BT_BINARY(&)
BT_BINARY(|)
BT_BINARY(^)
BT_BINARY(<<)
BT_BINARY(>>)
BT_BINARY(<)
BT_BINARY(>)
BT_BINARY(>=)
BT_BINARY(!=)
#undef BT_BINARY
template <class H> BT_HD Two<H> operator-(const Two<H>& a) { return {-a.low, -a.high}; }
template <class H> BT_HD Two<H> operator~(const Two<H>& a) { return {~a.low, ~a.high}; }

// Selects per lane: yes where the mask is set, else no.
template <class M, class V> BT_HD V choose(const M& m, const V& yes, const V& no) {
  if constexpr (is_two<V>)
    return {choose(m.low, yes.low, no.low), choose(m.high, yes.high, no.high)};
  else
    return m ? yes : no;
}
// Compares to masks.
template <class V> BT_HD auto above(const V& a, const V& b) { return a > b; }
template <class V> BT_HD auto at_least(const V& a, const V& b) { return a >= b; }
#if defined(__AVX512F__) && defined(__AVX512DQ__)
BT_HD MaskOfFloats above(const Vector<float>& a, const Vector<float>& b) {
  return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ)};
}
BT_HD MaskOfFloats at_least(const Vector<float>& a, const Vector<float>& b) {
  return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ)};
}
BT_HD Vector<float> choose(MaskOfFloats m, const Vector<float>& yes, const Vector<float>& no) {
  return (Vector<float>)_mm512_mask_blend_ps(m.m, (__m512)no, (__m512)yes);
}
#endif
// Computes a > b ? a : b and a < b ? a : b, single instructions that the compiler does not find.
template <class V> BT_HD V larger(const V& a, const V& b) {
  if constexpr (is_two<V>)
    return {larger(a.low, b.low), larger(a.high, b.high)};
  else
    return choose(a > b, a, b);
}
template <class V> BT_HD V smaller(const V& a, const V& b) {
  if constexpr (is_two<V>)
    return {smaller(a.low, b.low), smaller(a.high, b.high)};
  else
    return choose(a < b, a, b);
}
#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <> BT_HD Vector<float> larger(const Vector<float>& a, const Vector<float>& b) {
  return (Vector<float>)_mm512_maskz_max_ps(__mmask16(0xffff), (__m512)a, (__m512)b);
}
template <> BT_HD Vector<float> smaller(const Vector<float>& a, const Vector<float>& b) {
  return (Vector<float>)_mm512_maskz_min_ps(__mmask16(0xffff), (__m512)a, (__m512)b);
}
#elif defined(__AVX2__)
template <> BT_HD Vector<float> larger(const Vector<float>& a, const Vector<float>& b) {
  return (Vector<float>)_mm256_max_ps((__m256)a, (__m256)b);
}
template <> BT_HD Vector<float> smaller(const Vector<float>& a, const Vector<float>& b) {
  return (Vector<float>)_mm256_min_ps((__m256)a, (__m256)b);
}
#endif
// Converts to another type of the same width.
template <class To, class V> BT_HD To convert(const V& v) {
  if constexpr (is_two<V>)
    return {convert<decltype(To::low)>(v.low), convert<decltype(To::high)>(v.high)};
  else
    return __builtin_convertvector(v, To);
}
template <class To, class V> BT_HD To same_bits(const V& v) {
  static_assert(sizeof(To) == sizeof(V));
  if constexpr (is_two<V>) {
    return {same_bits<decltype(To::low)>(v.low), same_bits<decltype(To::high)>(v.high)};
  } else {
    To r;
    std::memcpy(&r, &v, sizeof r);
    return r;
  }
}
template <class V, class T> BT_HD V all_lanes(T value) {
  if constexpr (is_two<V>) {
    const auto half = all_lanes<decltype(V::low)>(value);
    return {half, half};
  } else {
    return value - V{};
  }
}
// Loads and stores, in halves, which the compiler would otherwise copy through the stack.
template <class V, class T> BT_HD V load_vector(const T* p) {
  if constexpr (is_two<V>) {
    using Half = decltype(V::low);
    return {load_vector<Half>(p), load_vector<Half>(p + sizeof(Half) / sizeof(T))};
  } else {
    V r;
    std::memcpy(&r, p, sizeof r);
    return r;
  }
}
template <class V, class T> BT_HD void store_vector(T* p, const V& v) {
  if constexpr (is_two<V>)
    store_vector(p, v.low), store_vector(p + sizeof(v.low) / sizeof(T), v.high);
  else
    std::memcpy(p, &v, sizeof v);
}
template <class V, class T> BT_HD void set_lane(V& v, int i, T value) {
  if constexpr (is_two<V>)
    std::memcpy(reinterpret_cast<char*>(&v) + i * sizeof value, &value, sizeof value);
  else
    v[i] = value;
}

// Converts floats to doubles, and back.
BT_HD Two<Vector<double>> widened_vector(const Vector<float>& a) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  const auto eight = [](__m256d half) { return _mm512_maskz_cvtps_pd(__mmask8(0xff), (__m256)half); };
  const __m512d all = (__m512d)a;
  return {(Vector<double>)eight(_mm512_maskz_extractf64x4_pd(0xf, all, 0)),
          (Vector<double>)eight(_mm512_maskz_extractf64x4_pd(0xf, all, 1))};
#elif defined(__AVX2__)
  return {(Vector<double>)_mm256_cvtps_pd(_mm256_castps256_ps128((__m256)a)),
          (Vector<double>)_mm256_cvtps_pd(_mm256_extractf128_ps((__m256)a, 1))};
#else
  Two<Vector<double>> r;
  constexpr int n = kVectorBytes / 8;
  for (int i = 0; i < n; ++i) r.low[i] = a[i], r.high[i] = a[n + i];
  return r;
#endif
}
BT_HD Vector<float> narrowed_vector(const Two<Vector<double>>& a) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  const auto eight = [](const Vector<double>& v) { return (__m256d)_mm512_maskz_cvtpd_ps(0xff, (__m512d)v); };
  return (Vector<float>)_mm512_maskz_insertf64x4(0xff, _mm512_castpd256_pd512(eight(a.low)), eight(a.high), 1);
#elif defined(__AVX2__)
  return (Vector<float>)_mm256_set_m128(_mm256_cvtpd_ps((__m256d)a.high), _mm256_cvtpd_ps((__m256d)a.low));
#else
  Vector<float> r;
  constexpr int n = kVectorBytes / 8;
  for (int i = 0; i < n; ++i) r[i] = float(a.low[i]), r[n + i] = float(a.high[i]);
  return r;
#endif
}
template <class V> BT_HD auto all_widened(const V& a) {
  if constexpr (is_two<V>)
    return Wide<double>{widened_vector(a.low), widened_vector(a.high)};
  else
    return widened_vector(a);
}
template <class V> BT_HD Wide<float> all_narrowed(const V& a) {
  if constexpr (is_two<std::remove_const_t<decltype(a.low)>>)
    return {narrowed_vector(a.low), narrowed_vector(a.high)};
  else
    return narrowed_vector(a);
}

#if defined(__AVX2__)
BT_HD Wide<float> joined(__m256 low, __m256 high) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  return (Wide<float>)_mm512_maskz_insertf32x8(__mmask16(0xffff), _mm512_castps256_ps512(low), high, 1);
#else
  return {(Vector<float>)low, (Vector<float>)high};
#endif
}
#endif

// Returns a mask's bits, one per lane.
BT_HD uint32_t bits(const MaskOfFloats& m) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  return m.m;
#elif defined(__AVX2__)
  return _mm256_movemask_ps((__m256)m);
#else
  uint32_t r = 0;
  for (int i = 0; i < kVectorBytes / 4; ++i) r |= uint32_t(m[i] & 1) << i;
  return r;
#endif
}
BT_HD uint32_t bits(const MaskOfDoubles& m) {
  uint32_t r = 0;
  for (int i = 0; i < kVectorBytes / 8; ++i) r |= uint32_t(m[i] & 1) << i;
  return r;
}
template <class H> BT_HD uint32_t bits(const Two<H>& m) {
  return bits(m.low) | bits(m.high) << (sizeof(H) / sizeof(m[0]));
}

// Rounds down to integers.
template <class V> BT_HD V round_down(const V& a) {
  if constexpr (is_two<V>) {
    return {round_down(a.low), round_down(a.high)};
  } else {
    V r;
    for (size_t i = 0; i < sizeof(V) / sizeof(a[0]); ++i) r[i] = floor_(a[i]);
    return r;
  }
}
#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <> BT_HD Vector<float> round_down(const Vector<float>& a) {
  return (Vector<float>)_mm512_maskz_roundscale_ps(__mmask16(0xffff), (__m512)a, _MM_FROUND_TO_NEG_INF);
}
#elif defined(__AVX2__)
template <> BT_HD Vector<float> round_down(const Vector<float>& a) { return (Vector<float>)_mm256_floor_ps((__m256)a); }
#endif

BT_HD Vector<float> square_root(const Vector<float>& a) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  return (Vector<float>)_mm512_maskz_sqrt_ps(__mmask16(0xffff), (__m512)a);
#elif defined(__AVX2__)
  return (Vector<float>)_mm256_sqrt_ps((__m256)a);
#else
  Vector<float> r;
  for (int i = 0; i < kVectorBytes / 4; ++i) r[i] = sqrt_(a[i]);
  return r;
#endif
}
BT_HD Vector<double> square_root(const Vector<double>& a) {
  Vector<double> r;
  for (int i = 0; i < kVectorBytes / 8; ++i) r[i] = sqrt_(a[i]);
  return r;
}
template <class H> BT_HD Two<H> square_root(const Two<H>& a) { return {square_root(a.low), square_root(a.high)}; }

}  // namespace bt
