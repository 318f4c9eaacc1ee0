// Front-to-back blending of a pixel's fragments, its end, and its vector-Jacobian product.
#pragma once

#include <utility>

#include "core/surfel.h"

namespace bt {

// Sums over a pixel's fragments, each times its weight: rgb, 1 and beta; with maps also depth and normal.
constexpr int kImageChannels = 5, kMapChannels = 9;

// What comparing two reals gives: a bool, or one for each lane of a pack.
template <class T>
using MaskOf = decltype(std::declval<T>() < std::declval<T>());

// The weight of a fragment in front of which `transmittance` is left, and what is left behind it.
template <class T>
struct Blend {
  T weight, behind;
};
template <class T>
BT_HD Blend<T> blend(T sigma, T transmittance) {
  const T weight = sigma * transmittance;
  return {weight, transmittance - weight};
}

// Which of the open pixels take the fragment. One that would leave a pixel less than `stop` is not blended and ends the
// pixel: it takes no more light.
template <class T>
struct Verdict {
  MaskOf<T> takes, ends;
};
template <class T>
BT_HD Verdict<T> judge(MaskOf<T> open, T sigma, T behind, T stop) {
  const MaskOf<T> covers = open & (sigma >= T(kAlphaMin));
  Verdict<T> v;
  v.takes = covers & (behind >= stop);
  v.ends = covers & (behind < stop);
  return v;
}

// dL/dsigma of a fragment, back to front: `later` is the sum of w dL/dw over the fragments behind it, which it joins.
template <class S>
BT_HD S blend_vjp(S weight, S sigma, S dweight, S& later) {
  const S dsigma = weight / sigma * dweight - later / (S(1) - sigma);
  later += weight * dweight;
  return dsigma;
}

}  // namespace bt
