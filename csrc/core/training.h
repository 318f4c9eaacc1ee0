// Adam's step, for parameters of surfels and corrections of photographs; structural similarity (Wang et al. 2004).
#pragma once

#include "core/common.h"

namespace bt {

// Coefficients of step number `step`, from 1: rate / (1 - beta1^step), root = 1 / sqrt(1 - beta2^step).
template <class S> struct AdamRates {
  S rate, root, beta2, keep1, keep2, eps;
};
template <class S> BT_HD AdamRates<S> adam_rates(double rate, double beta1, double beta2, double eps, double step) {
  return {S(rate / (1.0 - pow(beta1, step))),
          S(1.0 / sqrt(1.0 - pow(beta2, step))),
          S(beta2),
          S(1.0 - beta1),
          S(1.0 - beta2),
          S(eps)};
}

// Updates both moments by the gradient; returns the change of the parameter.
template <class S> BT_HD S adam_step(const AdamRates<S>& r, S gradient, S& mean, S& square) {
  mean += r.keep1 * (gradient - mean);
  square = r.beta2 * square + r.keep2 * gradient * gradient;
  return -r.rate * mean / (S(sqrt(square)) * r.root + r.eps);
}

// Corrections of photographs are rows of log gains [3], or of matrix and offset [3, 4] with log gains on the diagonal.
BT_HD bool is_log_gain(int width, int column) { return width == 3 || column % 5 == 0; }
// Returns an entry within its limit; one that is not a number is 0.
template <class S> BT_HD S limited_entry(S value, S limit) {
  return value > limit ? limit : value < -limit ? -limit : value == value ? value : S(0);
}

constexpr int kSsimTaps = 11;
constexpr double kSsimC1 = 0.01 * 0.01, kSsimC2 = 0.03 * 0.03;

// Gaussian window of standard deviation 1.5, normalised.
template <class S> struct SsimWindow {
  S k[kSsimTaps];
  SsimWindow() {
    double total = 0, value[kSsimTaps];
    for (int i = 0; i < kSsimTaps; ++i) {
      const double d = i - kSsimTaps / 2;
      total += value[i] = std::exp(-d * d / (2 * 1.5 * 1.5));
    }
    for (int i = 0; i < kSsimTaps; ++i) k[i] = S(value[i] / total);
  }
};

template <class S> BT_HD void add_moments(S k, S a, S b, S* means) {
  const S ka = k * a, kb = k * b;
  means[0] += ka, means[1] += kb, means[2] += ka * a, means[3] += kb * b, means[4] += ka * b;
}

// Computes SSIM from the means of a window. d: derivatives with respect to the means of a, a^2 and a b; a pixel p of
// weight k gets k (d[0] + 2 a_p d[1] + b_p d[2]).
template <class S> BT_HD S ssim_window(S a, S b, S aa, S bb, S ab, S* d) {
  const S c1 = S(kSsimC1), c2 = S(kSsimC2), one = S(1.0f), two = S(2.0f);
  const S p = two * a * b + c1, q = two * (ab - a * b) + c2;
  const S r = a * a + b * b + c1, t = (aa - a * a) + (bb - b * b) + c2;
  const S i = one / (r * t), value = p * q * i;
  d[0] = two * (b * (q - p) * i - a * value * (one / r - one / t));
  d[1] = -value / t;
  d[2] = two * p * i;
  return value;
}
// Computes the gradient of pixel a from the sums of k d over its windows.
template <class S> BT_HD S ssim_pixel_gradient(S a, S b, S d0, S d1, S d2) { return d0 + S(2.0f) * a * d1 + b * d2; }

}  // namespace bt
