// Scalars, small vectors and elementary functions, for host and device.
// A "real" T is float, double, or Lanes (cpu/simd.h), which overload the same functions.
#pragma once

#include <cmath>
#include <cstdint>
#include <utility>

#if defined(__CUDACC__)
#define BT_HD __host__ __device__ __forceinline__
#else
#define BT_HD inline __attribute__((always_inline))
#endif
// Before loops whose indices nvcc must know, so that arrays stay in registers.
#if defined(__CUDA_ARCH__)
#define BT_UNROLL _Pragma("unroll")
#else
#define BT_UNROLL
#endif

namespace bt {

BT_HD float exp_(float x) { return expf(x); }
BT_HD double exp_(double x) { return exp(x); }
BT_HD float log_(float x) { return logf(x); }
BT_HD double log_(double x) { return log(x); }
BT_HD float sqrt_(float x) { return sqrtf(x); }
BT_HD double sqrt_(double x) { return sqrt(x); }
BT_HD float sin_(float x) { return sinf(x); }
BT_HD double sin_(double x) { return sin(x); }
BT_HD float cos_(float x) { return cosf(x); }
BT_HD double cos_(double x) { return cos(x); }
BT_HD float floor_(float x) { return floorf(x); }
BT_HD double floor_(double x) { return floor(x); }
BT_HD bool finite_(float x) { return fabsf(x) <= 3.402823466e38f; }  // false for NaN as well
BT_HD bool finite_(double x) { return fabs(x) <= 1.7976931348623157e308; }

// Type of a comparison of two reals: bool, or a mask with one per lane.
template <class T> using MaskOf = decltype(std::declval<T>() < std::declval<T>());
BT_HD bool not_(bool m) { return !m; }
BT_HD bool any_(bool m) { return m; }

template <class T> BT_HD T select(bool condition, T yes, T no) { return condition ? yes : no; }
template <class T> BT_HD T max_(T a, T b) { return select(a > b, a, b); }
template <class T> BT_HD T min_(T a, T b) { return select(a < b, a, b); }
template <class T> BT_HD T abs_(T x) { return select(x < T(0.0f), -x, x); }
// Keeps NaN, so that a broken parameter shows.
template <class T> BT_HD T relu(T x) { return select(x < T(0.0f), T(0.0f), x); }
template <class T> BT_HD T clamp_(T x, T low, T high) { return min_(max_(x, low), high); }

// Converts to double (or lanes of doubles), and back.
BT_HD double widened(float x) { return x; }
BT_HD double widened(double x) { return x; }
template <class T> using Widened = decltype(widened(std::declval<T>()));
template <class T> BT_HD T narrowed(double x) { return T(x); }

// x^y for x > 0
template <class T> BT_HD T power_(T x, T y) { return exp_(y * log_(x)); }

// sigmoid without overflow for any finite x
template <class T> BT_HD T sigmoid(T x) {
  const T one = T(1.0f), e = exp_(-abs_(x));
  return select(x < T(0.0f), e, one) / (one + e);
}

template <class S> struct Vec3 {
  S x, y, z;
};
template <class S> BT_HD Vec3<S> operator+(Vec3<S> a, Vec3<S> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class S> BT_HD Vec3<S> operator-(Vec3<S> a, Vec3<S> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class S> BT_HD Vec3<S> operator*(S k, Vec3<S> a) { return {k * a.x, k * a.y, k * a.z}; }
template <class S> BT_HD S dot(Vec3<S> a, Vec3<S> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class S> BT_HD Vec3<S> cross(Vec3<S> a, Vec3<S> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class S> BT_HD Vec3<S> load3(const S* p) { return {p[0], p[1], p[2]}; }
template <class S> BT_HD void store3(S* p, Vec3<S> a) { p[0] = a.x, p[1] = a.y, p[2] = a.z; }

// Normalises a vector; those shorter than the floor are divided by it.
template <class S> struct Unit {
  Vec3<S> n;
  S inv;           // 1 / max(|a|, floor)
  MaskOf<S> full;  // |a| above the floor
};
template <class S> BT_HD Unit<S> normalize(Vec3<S> a) {
  const S floor_len = S(1e-12), one = S(1.0f), floor_inv = one / floor_len;
  // scaled by the largest entry: |a|^2 neither overflows nor underflows
  const S big = max_(abs_(a.x), max_(abs_(a.y), abs_(a.z)));
  const MaskOf<S> full = big > floor_len;
  const Vec3<S> b = (one / select(full, big, one)) * a;
  const S inv = one / sqrt_(dot(b, b));
  return {select(full, inv * b, floor_inv * a), select(full, inv / big, floor_inv), full};
}
// Computes d loss / d a from d loss / d n.
template <class S> BT_HD Vec3<S> normalize_vjp(const Unit<S>& u, Vec3<S> dn) {
  return u.inv * select(u.full, dn - dot(dn, u.n) * u.n, dn);
}

}  // namespace bt
