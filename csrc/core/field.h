// The residual colour field rho(x): contraction of space, multiresolution hash encoding and a small MLP, eq. (color).
#pragma once

#include "core/common.h"

namespace bt {

constexpr int kFeatures = 4;  // a level
constexpr int kWidth = 16;    // of both hidden layers
constexpr int kMaxLevels = 4;

// Unsigned integers as wide as a real; hashing needs their low 32 bits only.
template <class T>
struct IndexOf {
  using type = uint32_t;
};
BT_HD uint32_t to_index(float x) { return uint32_t(int32_t(x)); }
BT_HD uint32_t to_index(double x) { return uint32_t(int32_t(x)); }

// Grid coordinate in [0, 1]^3 of a world position. With contraction p -> (2 - 1/|p|) p/|p| outside the unit ball
// (mip-NeRF 360) and the ball of radius 2 fills the cube; without it the cube of half edge `half` does, clamped.
template <class S, class T>
BT_HD Vec3<T> grid_coordinate(Vec3<T> x, Vec3<S> mid, S half, bool contract) {
  const T k = T(S(1) / half), one = T(S(1)), zero = T(S(0));
  const Vec3<T> p = {k * (x.x - T(mid.x)), k * (x.y - T(mid.y)), k * (x.z - T(mid.z))};
  const T h = T(S(0.5));
  if (!contract)
    return {clamp_(h * (p.x + one), zero, one), clamp_(h * (p.y + one), zero, one), clamp_(h * (p.z + one), zero, one)};
  const T ir = one / sqrt_(max_(dot(p, p), one));  // 1 inside the ball, where the factor below is then 1
  const T q = T(S(0.25)) * (T(S(2)) - ir) * ir;
  return {q * p.x + h, q * p.y + h, q * p.z + h};
}
template <class S>
BT_HD Vec3<S> grid_coordinate_vjp(Vec3<S> x, Vec3<S> mid, S half, bool contract, Vec3<S> dc) {
  const Vec3<S> p = (S(1) / half) * (x - mid);
  if (!contract) {
    const S k = S(0.5) / half;
    return {p.x > S(-1) && p.x < S(1) ? k * dc.x : S(0), p.y > S(-1) && p.y < S(1) ? k * dc.y : S(0),
            p.z > S(-1) && p.z < S(1) ? k * dc.z : S(0)};
  }
  const S r2 = dot(p, p), k = S(0.25) / half;
  if (!(r2 > S(1))) return k * dc;
  const S ir = S(1) / sqrt_(r2);
  const Vec3<S> n = ir * p;
  const S tangential = (S(2) - ir) * ir, radial = ir * ir;
  const S along = dot(n, dc);
  return k * (tangential * (dc - along * n) + (radial * along) * n);
}

// Eight corners of a level's cell: entries of the hash table and trilinear weights. Corner c has bit 0 for x, 1 for y,
// 2 for z. XOR of coordinate times prime with the standard primes.
template <class T>
struct Corners {
  typename IndexOf<T>::type index[8];
  T weight[8];
  T fx, fy, fz;  // position in the cell
};
template <class T>
BT_HD void corners(Vec3<T> c, T resolution, uint32_t mask, Corners<T>& r) {
  using U = typename IndexOf<T>::type;
  const T px = c.x * resolution, py = c.y * resolution, pz = c.z * resolution;
  const T bx = floor_(px), by = floor_(py), bz = floor_(pz), one = T(1.0f);
  r.fx = px - bx, r.fy = py - by, r.fz = pz - bz;
  const U x0 = to_index(bx), y0 = to_index(by) * 2654435761u, z0 = to_index(bz) * 805459861u;
  const U x1 = x0 + 1u, y1 = y0 + 2654435761u, z1 = z0 + 805459861u;
  const U yz[4] = {y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1};
  const T gx = one - r.fx, gy = one - r.fy, gz = one - r.fz;
  const T wyz[4] = {gy * gz, r.fy * gz, gy * r.fz, r.fy * r.fz};
  for (int i = 0; i < 4; ++i) {
    r.index[2 * i] = (x0 ^ yz[i]) & mask, r.index[2 * i + 1] = (x1 ^ yz[i]) & mask;
    r.weight[2 * i] = gx * wyz[i], r.weight[2 * i + 1] = r.fx * wyz[i];
  }
}

// The MLP on rows of kWidth values. `Row` is a pack of kWidth reals; weights are stored input-major, w3 output-major
// (three rows), and the transposes serve the backward pass.
template <class S, class Row>
struct Mlp {
  Row w1[kMaxLevels * kFeatures], w2[kWidth], w3[3], w1t[kWidth], w2t[kWidth];
  int inputs;
};
template <class S, class Row>
struct MlpState {
  Row h1, h2;
};
template <class S, class Row>
BT_HD Row product(const Row* w, const S* in, int n) {
  Row a = Row(S(0)), b = Row(S(0));  // two chains hide the latency of the multiply-add
  for (int i = 0; i < n; i += 2) {
    a += w[i] * Row(in[i]);
    b += w[i + 1] * Row(in[i + 1]);
  }
  return a + b;
}
template <class S, class Row>
BT_HD Vec3<S> mlp(const Mlp<S, Row>& m, const S* features, MlpState<S, Row>& state) {
  S h[kWidth];
  state.h1 = relu(product(m.w1, features, m.inputs));
  store(h, state.h1);
  state.h2 = relu(product(m.w2, h, kWidth));
  return {sum(state.h2 * m.w3[0]), sum(state.h2 * m.w3[1]), sum(state.h2 * m.w3[2])};
}
// Adds the weights' gradients to g (w1, w2, w3 used) and returns those of the features.
template <class S, class Row>
BT_HD Row mlp_vjp(const Mlp<S, Row>& m, const S* features, const MlpState<S, Row>& state, Vec3<S> d, Mlp<S, Row>& g) {
  S h[kWidth];
  const Row zero = Row(S(0));
  g.w3[0] += state.h2 * Row(d.x), g.w3[1] += state.h2 * Row(d.y), g.w3[2] += state.h2 * Row(d.z);
  Row g2 = m.w3[0] * Row(d.x) + m.w3[1] * Row(d.y) + m.w3[2] * Row(d.z);
  g2 = select(state.h2 > zero, g2, zero);
  store(h, state.h1);
  for (int i = 0; i < kWidth; ++i) g.w2[i] += g2 * Row(h[i]);
  store(h, g2);
  const Row g1 = select(state.h1 > zero, product(m.w2t, h, kWidth), zero);
  for (int i = 0; i < m.inputs; ++i) g.w1[i] += g1 * Row(features[i]);
  store(h, g1);
  return product(m.w1t, h, kWidth);
}

}  // namespace bt
