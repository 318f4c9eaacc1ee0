// A real with the GPU's approximations: exp2, log2, square root and reciprocal of the special function unit, about 2
// ulp each, usable in the formulas of core/.
#pragma once

#include <type_traits>

#include "core/common.h"
#include "cuda/device.h"

namespace bt::cuda {

struct FastFloat {
  float v;
  FastFloat() = default;
  BT_HD explicit FastFloat(float value) : v(value) {}
#if defined(__CUDACC__)
  // Replace those of core/common.h by one instruction or none; friends, so that floats do not use them.
  friend __device__ __forceinline__ FastFloat clamp_(FastFloat x, FastFloat low, FastFloat high) {
    return FastFloat(fminf(fmaxf(x.v, low.v), high.v));
  }
  friend __device__ __forceinline__ FastFloat abs_(FastFloat x) { return FastFloat(fabsf(x.v)); }
  friend __device__ __forceinline__ FastFloat relu(FastFloat x) {  // keeps NaN
#if __CUDA_ARCH__ >= 800
    float y;
    asm("max.NaN.f32 %0, %1, 0f00000000;" : "=f"(y) : "f"(x.v));
    return FastFloat(y);
#else
    return FastFloat(x.v < 0 ? 0 : x.v);
#endif
  }
#endif
};
BT_HD FastFloat operator+(FastFloat a, FastFloat b) { return FastFloat(a.v + b.v); }
BT_HD FastFloat operator-(FastFloat a, FastFloat b) { return FastFloat(a.v - b.v); }
BT_HD FastFloat operator-(FastFloat a) { return FastFloat(-a.v); }
BT_HD FastFloat operator*(FastFloat a, FastFloat b) { return FastFloat(a.v * b.v); }
BT_HD FastFloat& operator+=(FastFloat& a, FastFloat b) { return a = a + b; }
BT_HD FastFloat& operator-=(FastFloat& a, FastFloat b) { return a = a - b; }
BT_HD bool operator<(FastFloat a, FastFloat b) { return a.v < b.v; }
BT_HD bool operator>(FastFloat a, FastFloat b) { return a.v > b.v; }

#if defined(__CUDACC__)
__device__ __forceinline__ float exp2_approx(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ float log2_approx(float x) {
  float y;
  asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ FastFloat operator/(FastFloat a, FastFloat b) { return FastFloat(__fdividef(a.v, b.v)); }
// Computes 1 / x; infinite below 1.2e-38.
__device__ __forceinline__ FastFloat inverse_(FastFloat x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x.v));
  return FastFloat(y);
}
__device__ __forceinline__ FastFloat exp_(FastFloat x) { return FastFloat(exp2_approx(x.v * 1.44269504f)); }
__device__ __forceinline__ FastFloat log_(FastFloat x) { return FastFloat(log2_approx(x.v) * 0.693147181f); }
__device__ __forceinline__ FastFloat sqrt_(FastFloat x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x.v));
  return FastFloat(y);
}
__device__ __forceinline__ FastFloat power_(FastFloat x, FastFloat y) {
  return FastFloat(exp2_approx(y.v * log2_approx(x.v)));
}
#else
inline FastFloat operator/(FastFloat a, FastFloat b) { return FastFloat(a.v / b.v); }
inline FastFloat exp_(FastFloat x) { return FastFloat(exp2f(x.v * 1.44269504f)); }
inline FastFloat log_(FastFloat x) { return FastFloat(logf(x.v)); }
inline FastFloat sqrt_(FastFloat x) { return FastFloat(sqrtf(x.v)); }
inline FastFloat power_(FastFloat x, FastFloat y) { return FastFloat(exp2f(y.v * log2f(x.v))); }
#endif

// The real for pixels in training kernels; doubles stay exact.
template <class S> using FastFloatOr = std::conditional_t<std::is_same_v<S, float>, FastFloat, S>;
BT_HD float plain(FastFloat x) { return x.v; }
BT_HD double plain(double x) { return x; }

}  // namespace bt::cuda
