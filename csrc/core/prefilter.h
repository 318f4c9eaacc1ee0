// Beta kernel averaged over a pixel: a prefilter that keeps the total, centre and second moments of a surfel's
// coverage, however small or thin it is, as EWA splatting does (Zwicker et al. 2002; derivation in docs/numerics.md).
//
// Sigma = n^2 [[u2^2 + v2^2, -(u1 u2 + v1 v2)], [., u1^2 + v1^2]] is the projected scale ellipse in pixels^2, omega =
// W / w0 the perspective at the pixel, c = kPixelVariance 2 (beta + 2) / 9 the blur. Then
//   q   = d^T (omega^2 Sigma + c)^-1 d = (omega^2 n^2 (U^2 + V^2) + c d^2) / D,
//   rho = omega^2 n w0 / sqrt(D),   D = (omega^2 n w0)^2 + c omega^2 tr Sigma + c^2,
//   sigma = min(0.99, o rho (1 - q/9)+^beta),
// and q -> u^2 + v^2, rho -> 1 for large discs. Every sum has positive terms: nothing cancels, also edge-on.
#pragma once

#include "core/blend.h"

namespace bt {

constexpr double kPixelVariance = 0.25;  // pixels^2, along each axis

template <class T> struct Fragment {
  T u, v;      // surfel coordinates in scale units; clamped to the support in the low-pass branch, 0 without a hit
  T depth;     // camera z of the hit; of the centre in the low-pass branch
  T sigma;     // effective opacity
  T low_pass;  // 1 in the low-pass branch, else 0
};

template <class S> BT_HD S filter_variance(S beta) { return S(kPixelVariance * 2 / kSupport2) * (beta + S(2)); }
// tr Sigma
template <class S> BT_HD S filter_spread(const S* g) {
  const S n = g[kArea], a = n * g[kU1], b = n * g[kU2], c = n * g[kV1], d = n * g[kV2];
  return a * a + b * b + c * c + d * d;
}

// The filtered disc at offset (dx, dy) from the projected centre, pixels.
template <class T> struct FilteredHit {
  T U, V, r;       // r = sqrt(U^2 + V^2)
  T omega;         // W / w0; outside the disc's image that of the rim in the pixel's direction, which bounds it
  T beyond;        // r - 3 (W - w0) outside, 0 inside
  T Un, Vn, D, q;  // n U, n V
};
template <class S, class T> BT_HD FilteredHit<T> filtered_hit(const S* g, T dx, T dy) {
  FilteredHit<T> f;
  const T zero = T(S(0)), reach = T(S(kSupport)), w0 = T(g[kW0]), n = T(g[kArea]);
  const S c = filter_variance(g[kBeta]), spread = filter_spread(g);
  const T tilt = slope(g, kW1, dx, dy);  // W - w0
  f.U = slope(g, kU1, dx, dy), f.V = slope(g, kV1, dx, dy);
  f.r = sqrt_(f.U * f.U + f.V * f.V);
  const auto outside = f.r > reach * (w0 + tilt);
  f.beyond = select(outside, f.r - reach * tilt, zero);
  f.omega = select(outside, f.r, w0 + tilt) / select(outside, f.beyond, w0);
  f.Un = n * f.U, f.Vn = n * f.V;
  const T w2 = f.omega * f.omega, a = w2 * T(g[kArea] * g[kW0]);
  f.D = a * a + (T(c * spread) * w2 + T(c * c));
  f.q = (w2 * (f.Un * f.Un + f.Vn * f.Vn) + T(c) * (dx * dx + dy * dy)) / f.D;
  return f;
}
// Returns true where the kernel is above 0.
template <class T> BT_HD MaskOf<T> in_support(const FilteredHit<T>& at) { return at.q < T(kSupport2); }
template <class S, class T> BT_HD Fragment<T> filtered_fragment(const S* g, S near, const FilteredHit<T>& at) {
  const T zero = T(S(0)), one = T(S(1)), r = T(S(kSupport));
  const T rest = one - at.q * T(S(1.0 / kSupport2));
  const auto inside = (rest > zero) & (T(g[kZ]) > T(near) * at.omega);
  const T kernel = select(inside, exp_(T(g[kBeta]) * log_(select(inside, rest, one))), zero);
  const T inv = one / (T(g[kW0]) * at.omega);
  const T rho = at.omega * at.omega * T(g[kArea] * g[kW0]) / sqrt_(at.D);
  Fragment<T> f;
  f.u = clamp_(at.U * inv, -r, r), f.v = clamp_(at.V * inv, -r, r);
  f.depth = T(g[kZ]) / at.omega;
  f.sigma = min_(T(S(kAlphaMax)), T(g[kOpacity]) * rho * kernel);
  f.low_pass = zero;
  return f;
}

// As fragment_vjp (core/kernel.h). 1 - x is bounded from below by the change of x over a pixel: the derivative then
// does not exceed that of the kernel averaged over the pixel, even at the rim for beta < 1. rim = 0: exact derivative.
template <class S, class T>
BT_HD void filtered_vjp(const S* g, S near, S rim, T dx, T dy, T dsigma, T du, T dv, T ddepth, T* d, T& ddx, T& ddy) {
  const T zero = T(S(0)), one = T(S(1)), two = T(S(2)), reach = T(S(kSupport));
  const T n = T(g[kArea]), w0 = T(g[kW0]), ninth = T(S(1.0 / kSupport2));
  const S c = filter_variance(g[kBeta]), spread = filter_spread(g);
  const FilteredHit<T> at = filtered_hit<S, T>(g, dx, dy);
  const T w = at.omega, w2 = w * w, inv_d = one / at.D, a = w2 * T(g[kArea] * g[kW0]);
  const T rho = a * sqrt_(inv_d);
  const T rest = max_(one - at.q * ninth, T(S(1e-30)));
  const T log_rest = log_(rest), kernel = rho * exp_(T(g[kBeta]) * log_rest);
  const auto open = (T(g[kOpacity]) * kernel < T(S(kAlphaMax))) & (T(g[kZ]) > T(near) * w);
  const T gs = select(open, dsigma, zero);
  d[kOpacity] += gs * kernel;
  const T gl = gs * T(g[kOpacity]) * kernel;  // d sigma / d log(rho kernel)
  const S bounded = rim > S(0) ? S(2) : S(0);
  const T across = T(bounded) * ninth * sqrt_(at.q * (w2 * T(spread) + T(S(2) * c)) * inv_d);  // change of x per pixel
  const T gq = -gl * T(g[kBeta]) * ninth / max_(rest, max_(across, T(rim)));
  const T gnum = gq * inv_d, gd = -(gq * at.q + T(S(0.5)) * gl) * inv_d;
  const T ga = gl / a + two * gd * a;
  const T gc = gnum * (dx * dx + dy * dy) + gd * (w2 * T(spread) + T(S(2) * c));
  d[kBeta] += gl * log_rest + gc * T(S(kPixelVariance * 2 / kSupport2));
  // with respect to omega, U, V, n, w0 and the coefficients in tr Sigma
  const T inv = one / (w0 * w), u = at.U * inv, v = at.V * inv;
  const T gu = select(u * u < reach * reach, du, zero), gv = select(v * v < reach * reach, dv, zero);
  const T pull = -(gu * u + gv * v) * inv;  // with respect to w0 omega
  const T square = at.Un * at.Un + at.Vn * at.Vn;
  const T gspread = gd * T(c) * w2;
  const T gw =
      two * w * (gnum * square + gd * T(c * spread) + ga * T(g[kArea] * g[kW0])) + pull * w0 - ddepth * T(g[kZ]) / w2;
  T gw0 = ga * w2 * n + pull * w;
  T gU = gu * inv + two * gnum * w2 * n * at.Un, gV = gv * inv + two * gnum * w2 * n * at.Vn;
  d[kArea] += ga * w2 * w0 + two * gnum * w2 * (at.Un * at.U + at.Vn * at.V) + two * gspread * T(spread / g[kArea]);
  d[kZ] += ddepth / w;
  // omega = W / w0 inside, r / (r - 3 (W - w0)) outside
  const auto outside = at.beyond > zero;
  const T ib = one / select(outside, at.beyond, w0);
  const T gr = select(outside, gw * ib * (one - w), zero);
  const T gW = select(outside, gw * ib * reach * w, gw * ib);
  gw0 = gw0 - select(outside, gW, gW * w);
  const T unit = one / select(at.r > zero, at.r, one);
  gU += gr * at.U * unit, gV += gr * at.V * unit;
  const T shared = two * gspread * n * n;
  d[kU1] += gU * dx + shared * T(g[kU1]), d[kU2] += gU * dy + shared * T(g[kU2]);
  d[kV1] += gV * dx + shared * T(g[kV1]), d[kV2] += gV * dy + shared * T(g[kV2]);
  d[kW0] += gw0 + gW;
  d[kW1] += gW * dx, d[kW2] += gW * dy;
  const T near_centre = two * gnum * T(c);
  ddx = gU * T(g[kU1]) + gV * T(g[kV1]) + gW * T(g[kW1]) + near_centre * dx;
  ddy = gU * T(g[kU2]) + gV * T(g[kV2]) + gW * T(g[kW2]) + near_centre * dy;
  d[kCx] -= ddx, d[kCy] -= ddy;
}

}  // namespace bt
