// Shading, and front-to-back blending of a pixel's fragments, its end, and their vector-Jacobian products.
#pragma once

#include "core/surfel.h"

namespace bt {

// Colour of a fragment, eq. (color): relu(relu(f_view + 0.5) + rho), rho the residual of the field or of a texel.
constexpr double kColorBias = 0.5;

// Computes relu(f_view + 0.5), the colour without residual.
template <class S> BT_HD S view_base(S f_view) { return relu(f_view + S(kColorBias)); }
template <class S> BT_HD Vec3<S> view_base(Vec3<S> f_view) {
  return {view_base(f_view.x), view_base(f_view.y), view_base(f_view.z)};
}
template <class S> BT_HD S shaded(S base, S residual) { return relu(base + residual); }
template <class S> BT_HD Vec3<S> shaded(Vec3<S> base, Vec3<S> residual) {
  return {shaded(base.x, residual.x), shaded(base.y, residual.y), shaded(base.z, residual.z)};
}

// Gradients through the ReLUs: the residual's where the outer one is open, the view colour's where both are.
template <class T> BT_HD T residual_gradient(T color, T dcolor) { return select(color > T(0.0f), dcolor, T(0.0f)); }
template <class S> BT_HD Vec3<S> residual_gradient(Vec3<S> color, Vec3<S> dcolor) {
  return {residual_gradient(color.x, dcolor.x), residual_gradient(color.y, dcolor.y),
          residual_gradient(color.z, dcolor.z)};
}
template <class S> BT_HD S base_gradient(S f_view, S dresidual) { return f_view > S(-kColorBias) ? dresidual : S(0); }
template <class S> BT_HD Vec3<S> base_gradient(Vec3<S> f_view, Vec3<S> dresidual) {
  return {base_gradient(f_view.x, dresidual.x), base_gradient(f_view.y, dresidual.y),
          base_gradient(f_view.z, dresidual.z)};
}

// Sums over a pixel's fragments, weighted: rgb, 1 and beta; with maps also depth and normal.
constexpr int kImageChannels = 5, kMapChannels = 9;
constexpr int channels_of(bool maps) { return maps ? kMapChannels : kImageChannels; }

// The weight of a fragment, and the transmittance behind it.
template <class T> struct Blend {
  T weight, behind;
};
template <class T> BT_HD Blend<T> blend(T sigma, T transmittance) {
  const T weight = sigma * transmittance;
  return {weight, transmittance - weight};
}

// Multiplies sigma by a texel's alpha m and clamps it.
template <class T> BT_HD T alpha_cut(T sigma, T m) { return min_(T(kAlphaMax), sigma * m); }

// The open pixels that take the fragment, and those it ends, as it would leave less transmittance than `stop`. One that
// would leave less than kTransmittanceMin is not blended, unless `stop` is smaller.
template <class T> struct BlendTest {
  MaskOf<T> takes, ends;
};
template <class T> BT_HD BlendTest<T> blend_test(MaskOf<T> open, T sigma, T behind, T stop) {
  const MaskOf<T> covers = open & (sigma >= T(kAlphaMin));
  BlendTest<T> v;
  v.takes = covers & (behind >= min_(stop, T(kTransmittanceMin)));
  v.ends = covers & (behind < stop);
  return v;
}

// Computes dL/dsigma of a fragment, back to front; `later`, the sum of w dL/dw behind it, is updated.
template <class S> BT_HD S blend_vjp(S weight, S sigma, S dweight, S& later) {
  const S dsigma = weight / sigma * dweight - later / (S(1) - sigma);
  later += weight * dweight;
  return dsigma;
}

// Adds a fragment to the sums of its pixel. By reference, so that numbers are loaded where they are used.
template <bool kMaps, class S>
BT_HD void add_blended(S weight, const S* color, const S& beta, const S& depth, const S* normal, S* sums) {
  sums[0] += weight * color[0], sums[1] += weight * color[1], sums[2] += weight * color[2];
  sums[3] += weight;
  sums[4] += weight * beta;
  if constexpr (kMaps) {
    sums[5] += weight * depth;
    sums[6] += weight * normal[0], sums[7] += weight * normal[1], sums[8] += weight * normal[2];
  }
}
// Compute dL/dweight from the gradient of the sums: the parts of the image and of the maps, and their sum.
template <class S> BT_HD S image_gradient(const S* d, const S* color, const S& beta) {
  return d[0] * color[0] + d[1] * color[1] + d[2] * color[2] + d[3] + d[4] * beta;
}
template <class S> BT_HD S map_gradient(const S* d, const S& depth, const S* normal) {
  return d[5] * depth + d[6] * normal[0] + d[7] * normal[1] + d[8] * normal[2];
}
template <bool kMaps, class S>
BT_HD S weight_gradient(const S* d, const S* color, const S& beta, const S& depth, const S* normal) {
  S gradient = image_gradient(d, color, beta);
  if constexpr (kMaps) gradient += map_gradient(d, depth, normal);
  return gradient;
}

}  // namespace bt
