// Pinhole camera: world to camera transform, sampling positions of pixels.
#pragma once

#include "core/common.h"

namespace bt {

// World to camera: x_cam = R x + t; pinhole in pixels.
template <class S> struct Pinhole {
  S R[9], t[3];  // row major
  S fx, fy, cx, cy;
};
// From viewmat [4, 4] and K [3, 3], row major.
template <class S> BT_HD Pinhole<S> pinhole(const S* viewmat, const S* K) {
  Pinhole<S> c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.R[3 * i + j] = viewmat[4 * i + j];
    c.t[i] = viewmat[4 * i + 3];
  }
  c.fx = K[0], c.fy = K[4], c.cx = K[2], c.cy = K[5];
  return c;
}
template <class S, class T> BT_HD Vec3<T> rotate(const S* R, Vec3<T> a) {
  return {T(R[0]) * a.x + T(R[1]) * a.y + T(R[2]) * a.z, T(R[3]) * a.x + T(R[4]) * a.y + T(R[5]) * a.z,
          T(R[6]) * a.x + T(R[7]) * a.y + T(R[8]) * a.z};
}
// Transforms a world point to the camera, in double: far from the origin R m and t cancel, which in float32 would leave
// only rounding errors.
template <class S, class T> BT_HD Vec3<T> to_camera(const Pinhole<S>& cam, Vec3<T> m) {
  using D = Widened<T>;
  const D x = widened(m.x), y = widened(m.y), z = widened(m.z);
  const S *R = cam.R, *t = cam.t;
  const auto row = [&](int k) {
    const D sum = D(double(R[3 * k])) * x + D(double(R[3 * k + 1])) * y + D(double(R[3 * k + 2])) * z + D(double(t[k]));
    return narrowed<T>(sum);
  };
  return {row(0), row(1), row(2)};
}
template <class S> BT_HD Vec3<S> rotate_transposed(const S* R, Vec3<S> a) {
  return {R[0] * a.x + R[3] * a.y + R[6] * a.z, R[1] * a.x + R[4] * a.y + R[7] * a.z,
          R[2] * a.x + R[5] * a.y + R[8] * a.z};
}
// Computes the camera's centre in the world, -R^T t.
template <class S> BT_HD void camera_center(const S* viewmat, double* center) {
  const S* m = viewmat;
  for (int k = 0; k < 3; ++k) center[k] = -(double(m[k]) * m[3] + double(m[4 + k]) * m[7] + double(m[8 + k]) * m[11]);
}
// Returns the sampling position of pixel i of a row or column, in pixels.
template <class S> BT_HD S pixel_centre(int i) { return S(i) + S(0.5); }

}  // namespace bt
