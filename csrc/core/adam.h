// Adam's step, for parameters of surfels and corrections of photographs.
#pragma once

#include <cmath>

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

}  // namespace bt
