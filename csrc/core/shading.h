// Colour of a fragment, eq. (color): relu(relu(f_view + 0.5) + rho), rho the residual of the field or of a texel.
#pragma once

#include "core/common.h"

namespace bt {

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

// Gradients through the ReLUs: the residual's passes where the outer one is open, the view colour's, from the sum of
// the residual's, where the inner one is open too.
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

}  // namespace bt
