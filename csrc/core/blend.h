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

// What is blended of a fragment: the sums of a pixel are over these times the weight, in this order with a 1 after the
// colour; depth and normal in maps alone.
template <class S>
struct Blended {
  Vec3<S> color;
  S beta, depth;
  Vec3<S> normal;
};
template <bool kMaps, class S>
BT_HD Blended<S> blended(const S* g, const S* color, const S* depth) {
  Blended<S> b = {};
  b.color = load3(color), b.beta = g[kBeta];
  if constexpr (kMaps) b.depth = *depth, b.normal = load3(g + kNx);
  return b;
}
template <bool kMaps, class S>
BT_HD void add_blended(S weight, const Blended<S>& b, S* sums) {
  sums[0] += weight * b.color.x, sums[1] += weight * b.color.y, sums[2] += weight * b.color.z;
  sums[3] += weight;
  sums[4] += weight * b.beta;
  if constexpr (kMaps) {
    sums[5] += weight * b.depth;
    sums[6] += weight * b.normal.x, sums[7] += weight * b.normal.y, sums[8] += weight * b.normal.z;
  }
}
// dL/dweight from the gradient of the sums.
template <bool kMaps, class S>
BT_HD S weight_gradient(const Blended<S>& b, const S* d) {
  S gradient = d[0] * b.color.x + d[1] * b.color.y + d[2] * b.color.z + d[3] + d[4] * b.beta;
  if constexpr (kMaps) gradient += d[5] * b.depth + d[6] * b.normal.x + d[7] * b.normal.y + d[8] * b.normal.z;
  return gradient;
}

}  // namespace bt
