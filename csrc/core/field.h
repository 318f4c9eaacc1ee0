// Residual colour field rho(x), eq. (color): contraction of space, multiresolution hash encoding (Instant NGP, Müller
// et al. 2022) and a small MLP.
#pragma once

#include "core/common.h"

namespace bt {

constexpr int kFeatures = 4;  // per level
constexpr int kWidth = 16;    // of both hidden layers
constexpr int kMaxLevels = 4;

template <class S> struct FieldArrays {
  int levels, log2_size, min_resolution;
  bool contract;
  S mid[3], half;
  const S *table, *w1, *w2, *w3;  // [levels, 2^log2_size, 4], [4 levels, 16], [16, 16], [16, 3]

  // Index of a level's first entry; count of the table's numbers.
  BT_HD int64_t first_entry(int level) const { return int64_t(level) << log2_size; }
  BT_HD int64_t table_size() const { return first_entry(levels) * kFeatures; }
  BT_HD uint32_t hash_mask() const { return (1u << log2_size) - 1u; }
  BT_HD S resolution(int level) const { return S(min_resolution << level); }  // cells along an edge
  // as in ops/arguments.h
  template <class R> void fields(R& r) {
    r.numbers("levels", levels, "log2_size", log2_size, "min_resolution", min_resolution, "contract", contract, "mid",
              mid, "half", half);
    if (levels < 1 || levels > kMaxLevels || log2_size < 1 || log2_size > 28)
      r.refuse("a field has 1 to 4 levels and 2 to 2^28 entries per level");
    r.wide("table", table, table_size());
    r.array("w1", w1, levels * kFeatures * kWidth);
    r.array("w2", w2, kWidth * kWidth);
    r.array("w3", w3, kWidth * 3);
  }
};
template <class S> struct FieldGradients {
  S *table, *w1, *w2, *w3;

  template <class R> void fields(R& r, const FieldArrays<S>& field) {
    r.wide("dtable", table, field.table_size());
    r.array("dw1", w1, field.levels * kFeatures * kWidth);
    r.array("dw2", w2, kWidth * kWidth);
    r.array("dw3", w3, kWidth * 3);
  }
};

// Unsigned integer as wide as a real; hashing uses its low 32 bits.
template <class T> struct IndexOf {
  using type = uint32_t;
};
BT_HD uint32_t to_index(float x) { return uint32_t(int32_t(x)); }
BT_HD uint32_t to_index(double x) { return uint32_t(int32_t(x)); }

// Maps a world position to grid coordinates in [0, 1]^3. With contraction p -> (2 - 1/|p|) p/|p| outside the unit ball
// (mip-NeRF 360, Barron et al. 2022) the ball of radius 2 fills the cube; without it the cube of half edge `half` does.
template <class S, class T> BT_HD Vec3<T> grid_coordinate(Vec3<T> x, Vec3<S> mid, S half, bool contract) {
  const T k = T(S(1) / half), one = T(S(1)), zero = T(S(0));
  const Vec3<T> p = {k * (x.x - T(mid.x)), k * (x.y - T(mid.y)), k * (x.z - T(mid.z))};
  const T h = T(S(0.5));
  if (!contract)
    return {clamp_(h * (p.x + one), zero, one), clamp_(h * (p.y + one), zero, one), clamp_(h * (p.z + one), zero, one)};
  const T ir = one / sqrt_(max_(dot(p, p), one));  // 1 inside the ball, which makes the factor below 1
  const T q = T(S(0.25)) * (T(S(2)) - ir) * ir;
  return {q * p.x + h, q * p.y + h, q * p.z + h};
}
template <class S> BT_HD Vec3<S> grid_coordinate_vjp(Vec3<S> x, Vec3<S> mid, S half, bool contract, Vec3<S> dc) {
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

// Corners of a level's cell: entries of the hash table and trilinear weights. Bits of the corner's index: x, y, z.
template <class T> struct Corners {
  typename IndexOf<T>::type index[8];
  T weight[8];
  T fx, fy, fz;                       // position in the cell
  typename IndexOf<T>::type x, y, z;  // the cell's first corner, y and z times their primes
};
template <class T> BT_HD void corners(Vec3<T> c, T resolution, uint32_t mask, Corners<T>& r) {
  using U = typename IndexOf<T>::type;
  const T px = c.x * resolution, py = c.y * resolution, pz = c.z * resolution;
  const T bx = floor_(px), by = floor_(py), bz = floor_(pz), one = T(1.0f);
  r.fx = px - bx, r.fy = py - by, r.fz = pz - bz;
  const U x0 = to_index(bx), y0 = to_index(by) * 2654435761u, z0 = to_index(bz) * 805459861u;
  const U x1 = x0 + 1u, y1 = y0 + 2654435761u, z1 = z0 + 805459861u;
  const U yz[4] = {y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1};
  const T gx = one - r.fx, gy = one - r.fy, gz = one - r.fz;
  const T wyz[4] = {gy * gz, r.fy * gz, gy * r.fz, r.fy * r.fz};
  r.x = x0, r.y = y0, r.z = z0;
  for (int i = 0; i < 4; ++i) {
    r.index[2 * i] = (x0 ^ yz[i]) & mask, r.index[2 * i + 1] = (x1 ^ yz[i]) & mask;
    r.weight[2 * i] = gx * wyz[i], r.weight[2 * i + 1] = r.fx * wyz[i];
  }
}

// Computes d loss / d grid coordinate from d loss / d interpolated value of each corner.
template <class S> BT_HD Vec3<S> cell_gradient(S fx, S fy, S fz, S resolution, const S* d) {
  const S gx = S(1) - fx, gy = S(1) - fy, gz = S(1) - fz;
  return {resolution *
              (gy * gz * (d[1] - d[0]) + fy * gz * (d[3] - d[2]) + gy * fz * (d[5] - d[4]) + fy * fz * (d[7] - d[6])),
          resolution *
              (gx * gz * (d[2] - d[0]) + fx * gz * (d[3] - d[1]) + gx * fz * (d[6] - d[4]) + fx * fz * (d[7] - d[5])),
          resolution *
              (gx * gy * (d[4] - d[0]) + fx * gy * (d[5] - d[1]) + gx * fy * (d[6] - d[2]) + fx * fy * (d[7] - d[3]))};
}

// MLP on rows of kWidth values, one lane each; weights are stored input-major, w3 output-major (three rows), and
// transposed for the backward pass. With fewer levels than kMaxLevels the unused inputs and rows of w1 are 0.
constexpr int kInputs = kMaxLevels * kFeatures;
static_assert(kInputs == kWidth, "features and hidden layers share one type of row");
template <class S, class Row> struct Mlp {
  Row w1[kInputs], w2[kWidth], w3[3], w1t[kWidth], w2t[kWidth];
};
template <class S, class Row> struct MlpState {
  Row h1, h2;
};
template <class Row> struct MlpGradient {
  Row g1, g2;
};
// sum_i w_i in_i
template <class S, class Row> BT_HD Row product(const Row* w, const S* in) {
  Row a = Row(S(0)), b = Row(S(0));  // two chains hide the latency of multiply-adds
  for (int i = 0; i < kWidth; i += 2) {
    a += w[i] * Row(in[i]);
    b += w[i + 1] * Row(in[i + 1]);
  }
  return a + b;
}
template <class S, class Row> BT_HD Vec3<S> mlp(const Mlp<S, Row>& m, const S* features, MlpState<S, Row>& state) {
  S h[kWidth];
  state.h1 = relu(product(m.w1, features));
  store(h, state.h1);
  state.h2 = relu(product(m.w2, h));
  return {sum(state.h2 * m.w3[0]), sum(state.h2 * m.w3[1]), sum(state.h2 * m.w3[2])};
}
// Returns the gradient of the features from that of the output.
template <class S, class Row>
BT_HD Row mlp_vjp(const Mlp<S, Row>& m, const MlpState<S, Row>& state, Vec3<S> d, MlpGradient<Row>& g) {
  S h[kWidth];
  const Row zero = Row(S(0));
  g.g2 = m.w3[0] * Row(d.x) + m.w3[1] * Row(d.y) + m.w3[2] * Row(d.z);
  g.g2 = select(state.h2 > zero, g.g2, zero);
  store(h, g.g2);
  g.g1 = select(state.h1 > zero, product(m.w2t, h), zero);
  store(h, g.g1);
  return product(m.w1t, h);
}
// Adds the weights' gradients to w1, w2 and w3 of `sums`.
template <class S, class Row>
BT_HD void add_weight_gradient(const S* features, const MlpState<S, Row>& state, const MlpGradient<Row>& g, Vec3<S> d,
                               Mlp<S, Row>& sums) {
  S h[kWidth];
  sums.w3[0] += state.h2 * Row(d.x), sums.w3[1] += state.h2 * Row(d.y), sums.w3[2] += state.h2 * Row(d.z);
  store(h, state.h1);
  for (int i = 0; i < kWidth; ++i) sums.w2[i] += g.g2 * Row(h[i]);
  for (int i = 0; i < kInputs; ++i) sums.w1[i] += g.g1 * Row(features[i]);
}

}  // namespace bt
