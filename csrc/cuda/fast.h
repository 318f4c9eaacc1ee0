// A real for pixels with the device's own approximations: exp2, log2, root and reciprocal of the special function unit,
// about 2 ulp each. The formulas in core/ take it as they take a float.
#pragma once

#include <type_traits>

#include "core/common.h"
#include "cuda/device.h"

namespace bt::cuda {

struct Fast {
  float v;
  Fast() = default;
  BT_HD explicit Fast(float value) : v(value) {}
#if defined(__CUDACC__)
  // In place of those of core/common.h, of which these take one instruction, or none. Here, so that floats do not see
  // them.
  friend __device__ __forceinline__ Fast clamp_(Fast x, Fast low, Fast high) {
    return Fast(fminf(fmaxf(x.v, low.v), high.v));
  }
  friend __device__ __forceinline__ Fast abs_(Fast x) { return Fast(fabsf(x.v)); }
  friend __device__ __forceinline__ Fast relu(Fast x) {  // NaN stays NaN
#if __CUDA_ARCH__ >= 800
    float y;
    asm("max.NaN.f32 %0, %1, 0f00000000;" : "=f"(y) : "f"(x.v));
    return Fast(y);
#else
    return Fast(x.v < 0 ? 0 : x.v);
#endif
  }
#endif
};
BT_HD Fast operator+(Fast a, Fast b) { return Fast(a.v + b.v); }
BT_HD Fast operator-(Fast a, Fast b) { return Fast(a.v - b.v); }
BT_HD Fast operator-(Fast a) { return Fast(-a.v); }
BT_HD Fast operator*(Fast a, Fast b) { return Fast(a.v * b.v); }
BT_HD Fast& operator+=(Fast& a, Fast b) { return a = a + b; }
BT_HD Fast& operator-=(Fast& a, Fast b) { return a = a - b; }
BT_HD bool operator<(Fast a, Fast b) { return a.v < b.v; }
BT_HD bool operator>(Fast a, Fast b) { return a.v > b.v; }

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
__device__ __forceinline__ Fast operator/(Fast a, Fast b) { return Fast(__fdividef(a.v, b.v)); }
// 1 / x; infinite below 1.2e-38
__device__ __forceinline__ Fast inverse_(Fast x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x.v));
  return Fast(y);
}
__device__ __forceinline__ Fast exp_(Fast x) { return Fast(exp2_approx(x.v * 1.44269504f)); }
__device__ __forceinline__ Fast log_(Fast x) { return Fast(log2_approx(x.v) * 0.693147181f); }
__device__ __forceinline__ Fast sqrt_(Fast x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x.v));
  return Fast(y);
}
__device__ __forceinline__ Fast power_(Fast x, Fast y) { return Fast(exp2_approx(y.v * log2_approx(x.v))); }
#else
inline Fast operator/(Fast a, Fast b) { return Fast(a.v / b.v); }
inline Fast exp_(Fast x) { return Fast(exp2f(x.v * 1.44269504f)); }
inline Fast log_(Fast x) { return Fast(logf(x.v)); }
inline Fast sqrt_(Fast x) { return Fast(sqrtf(x.v)); }
inline Fast power_(Fast x, Fast y) { return Fast(exp2f(y.v * log2f(x.v))); }
#endif

// The real of a training kernel's pixels: doubles stay exact.
template <class S>
using FastOr = std::conditional_t<std::is_same_v<S, float>, Fast, S>;
BT_HD float plain(Fast x) { return x.v; }
BT_HD double plain(double x) { return x; }

}  // namespace bt::cuda
