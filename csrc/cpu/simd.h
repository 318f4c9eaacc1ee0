// Packs of 16 lanes on the compiler's vector extensions, with the functions that core/ expects of a real.
#pragma once

#include <cstring>
#include <type_traits>

#include "core/common.h"
#include "core/field.h"
#include "cpu/wide.h"

namespace bt {

template <class S>
struct Pack;

// Spelt out for each scalar: the compiler drops the vector attribute of a dependent type.
template <class S>
struct LaneTypes;
template <>
struct LaneTypes<float> {
  using M = decltype(Wide<float>{} > Wide<float>{});  // lanes of 0 or -1
  using U = Wide<uint32_t>;
  typedef float O __attribute__((vector_size(32)));
  typedef float Q __attribute__((vector_size(16)));
};
template <>
struct LaneTypes<double> {
  using M = decltype(Wide<double>{} > Wide<double>{});
  using U = Wide<uint64_t>;
  typedef double O __attribute__((vector_size(64)));
  typedef double Q __attribute__((vector_size(32)));
};
template <class S>
using Quad = typename LaneTypes<S>::Q;  // four lanes: a table entry, or rgba
template <class S>
using Oct = typename LaneTypes<S>::O;  // eight: two texels that lie next to each other

// relu of core/common.h; a Quad is no class and finds no function by its name
template <class S>
BT_HD Quad<S> relu_quad(Quad<S> a) {
  return a < S(0) ? Quad<S>{} : a;
}

template <class S>
struct IndexOf<Pack<S>> {
  using type = typename LaneTypes<S>::U;
};

template <class S>
struct Pack {
  using V = Wide<S>;
  using M = typename LaneTypes<S>::M;
  V v;
  Pack() = default;
  BT_HD Pack(const V& value) : v(value) {}
  BT_HD explicit Pack(S value) : v(all_lanes<V>(value)) {}
  template <class F, class = std::enable_if_t<std::is_floating_point_v<F> && !std::is_same_v<F, S>>>
  BT_HD explicit Pack(F value) : Pack(S(value)) {}
  BT_HD S operator[](int i) const { return v[i]; }
  BT_HD void set(int i, S value) { set_lane(v, i, value); }
};

template <class S>
BT_HD Pack<S> operator+(Pack<S> a, Pack<S> b) {
  return a.v + b.v;
}
template <class S>
BT_HD Pack<S> operator-(Pack<S> a, Pack<S> b) {
  return a.v - b.v;
}
template <class S>
BT_HD Pack<S> operator-(Pack<S> a) {
  return -a.v;
}
template <class S>
BT_HD Pack<S> operator*(Pack<S> a, Pack<S> b) {
  return a.v * b.v;
}
template <class S>
BT_HD Pack<S> operator/(Pack<S> a, Pack<S> b) {
  return a.v / b.v;
}
template <class S>
BT_HD Pack<S>& operator+=(Pack<S>& a, Pack<S> b) {
  a.v = a.v + b.v;
  return a;
}
template <class S>
BT_HD Pack<S>& operator-=(Pack<S>& a, Pack<S> b) {
  a.v = a.v - b.v;
  return a;
}
// Comparisons give lane masks, which combine with & | ~.
template <class S>
BT_HD typename Pack<S>::M operator>(Pack<S> a, Pack<S> b) {
  return a.v > b.v;
}
template <class S>
BT_HD typename Pack<S>::M operator<(Pack<S> a, Pack<S> b) {
  return a.v < b.v;
}
template <class S>
BT_HD typename Pack<S>::M operator>=(Pack<S> a, Pack<S> b) {
  return a.v >= b.v;
}
template <class S>
BT_HD Pack<S> select(typename Pack<S>::M m, Pack<S> yes, Pack<S> no) {
  return choose(m, yes.v, no.v);
}
template <class S>
BT_HD Pack<S> max_(Pack<S> a, Pack<S> b) {
  return choose(a.v > b.v, a.v, b.v);
}
template <class S>
BT_HD Pack<S> min_(Pack<S> a, Pack<S> b) {
  return choose(a.v < b.v, a.v, b.v);
}

// exp and log of floats: Cody-Waite reduction and a polynomial, below 2 ulp over the normal range.
BT_HD Pack<float> exp_(Pack<float> x) {
  using V = Pack<float>::V;
  using M = Pack<float>::M;
  V a = min_(max_(x, Pack<float>(-87.0f)), Pack<float>(88.0f)).v;
  const V magic = Pack<float>(12582912.0f).v;  // 1.5 * 2^23: adding it rounds to an integer
  const V n = (a * 1.44269504f + magic) - magic;
  const V f = (a - n * 0.693145752f) - n * 1.42860677e-6f;
  V p = 1.98412698e-4f * f + 1.38888889e-3f;
  p = p * f + 8.33333333e-3f;
  p = p * f + 4.16666667e-2f;
  p = p * f + 1.66666667e-1f;
  p = p * f + 0.5f;
  p = p * f + 1.0f;
  p = p * f + 1.0f;
  const V two_n = same_bits<V>((convert<M>(n) + 127) << 23);
  return choose(x.v < -87.0f, V{}, p * two_n);
}
BT_HD Pack<float> log_(Pack<float> x) {
  using V = Pack<float>::V;
  using M = Pack<float>::M;
  const M bits = same_bits<M>(x.v);
  // mantissa in [sqrt(1/2), sqrt(2)), so that the logarithm keeps its relative accuracy near 1
  const M shifted = bits - 0x3f3504f3;
  const M e = shifted >> 23;
  const V m = same_bits<V>((shifted & 0x007fffff) + 0x3f3504f3);
  const V f = m - 1.0f;
  const V s = f / (2.0f + f), s2 = s * s;
  // log(1+f) = 2 atanh(s)
  V p = 0.222221985f * s2 + 0.285714287f;
  p = p * s2 + 0.4f;
  p = p * s2 + 0.666666667f;
  const V r = s * s2 * p + 2.0f * s;
  const V n = convert<V>(e);
  return (r + n * 1.42860677e-6f) + n * 0.693145752f;
}
BT_HD Pack<double> exp_(Pack<double> x) {
  Pack<double> r;
  for (int i = 0; i < kLanes; ++i) r.set(i, std::exp(x[i]));
  return r;
}
BT_HD Pack<double> log_(Pack<double> x) {
  Pack<double> r;
  for (int i = 0; i < kLanes; ++i) r.set(i, std::log(x[i]));
  return r;
}

// The lane mask of such bits.
template <class S>
BT_HD typename Pack<S>::M mask_of(uint32_t b) {
  using M = typename Pack<S>::M;
  M number;
  for (int i = 0; i < kLanes; ++i) set_lane(number, i, std::decay_t<decltype(number[0])>(1 << i));
  return (number & int(b)) != 0;
}

// The lanes named by `keep`, next to each other; `to` has room for a whole pack.
template <class S>
BT_HD void compress(S* to, Pack<S> a, uint32_t keep) {
  compress_lanes(to, a.v, keep);
}

template <class S>
BT_HD Pack<S> load(const S* p) {
  Pack<S> r;
  std::memcpy(&r.v, p, sizeof r.v);
  return r;
}
template <class S>
BT_HD void store(S* p, Pack<S> a) {
  std::memcpy(p, &a.v, sizeof a.v);
}
template <class S>
BT_HD Pack<S> sqrt_(Pack<S> a) {
  return square_root(a.v);
}
template <class S>
BT_HD Pack<S> floor_(Pack<S> a) {
  // truncation, then one less where that went up; exact below 2^31
  using V = typename Pack<S>::V;
  const V t = convert<V>(convert<typename Pack<S>::M>(a.v));
  return t - choose(t > a.v, Pack<S>(S(1)).v, V{});
}
template <class S>
BT_HD typename IndexOf<Pack<S>>::type to_index(Pack<S> a) {
  return same_bits<typename IndexOf<Pack<S>>::type>(convert<typename Pack<S>::M>(a.v));
}
// Half of a vector: the lower one (0) or the upper one (1). GCC has the shuffle from version 12 on.
template <int which, class Half, class V>
BT_HD Half half(V v) {
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
// The lanes added to four: halves to halves.
template <class S, class V>
BT_HD Quad<S> folded(const V& v) {
  if constexpr (std::is_same_v<V, Quad<S>>)
    return v;
  else if constexpr (is_two<V>)
    return folded<S>(v.low + v.high);
  else if constexpr (std::is_same_v<V, Oct<S>>)
    return half<0, Quad<S>>(v) + half<1, Quad<S>>(v);
  else
    return folded<S>(half<0, Oct<S>>(v) + half<1, Oct<S>>(v));
}
template <class S>
BT_HD S sum(Pack<S> a) {
  const Quad<S> q = folded<S>(a.v);
  return (q[0] + q[2]) + (q[1] + q[3]);
}

}  // namespace bt
