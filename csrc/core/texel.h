// Positions of surfel coordinates in a tile: texel i of r has its centre at u = (i + 0.5) / r * 2 e - e, with e the
// half side of the tile in scale units (eq. texel centres).
#pragma once

#include <cstdint>

#include "core/surfel.h"

namespace bt {

// Position x of u among r texels along an axis of a tile, clamped to the outer texel centres. A bilinear fetch reads
// texels floor(x) and min(floor(x) + 1, r - 1); the fraction of x is the weight of the second.
template <class S, class T> BT_HD T texel_position(T u, int r, S extent) {
  const T x = (u + T(extent)) * T(S(r) / (S(2) * extent)) - T(S(0.5));
  return clamp_(x, T(S(0)), T(S(r - 1)));
}

// Computes the same for a tile of span + 1 texels, given k = 1 / (2 extent).
template <class S, class T> BT_HD T texel_position_scaled(T u, S span, S k) {
  return clamp_(u * T((span + S(1)) * k) + T(S(0.5) * span), T(S(0)), T(span));
}

// Mip levels of a tile: means of 2 x 2 texels of the level before. A level exists if the tile's position and sides are
// divisible by 2^level, so that these are also 2 x 2 texels of the page.
constexpr int kTileLevels = 3;
BT_HD bool has_level(const int32_t* tile, int level) {  // x, y, page, r_u, r_v
  return ((tile[0] | tile[1] | tile[3] | tile[4]) & ((1 << level) - 1)) == 0;
}
// Mip level with about one texel per pixel, by area, from a row g of geom. Halved at most as often as the view relative
// to the photographs, at whose size texels were trained. kTileLevels: at most 2 texels a side would be left, and the
// tile's mean replaces them.
template <class S> BT_HD int tile_level(const S* g, int r_u, int r_v, S extent, S photo_pixel) {
  const S k = S(0.5) / (extent * g[kW0]);  // texels per pixel along the gradient of u and v, squared
  const S u = g[kU1] * g[kU1] + g[kU2] * g[kU2], v = g[kV1] * g[kV1] + g[kV2] * g[kV2];
  const S area = sqrt_(u * v) * k * k * S(r_u) * S(r_v);  // texels per pixel, by area
  const S most = S(1) / (photo_pixel * photo_pixel);
  int level = 0, side = max_(r_u, r_v);
  // geometric mean of 4^l and 4^(l + 1) texels per pixel, those of two levels
  for (S size = S(2); level < kTileLevels && area > size && most >= size; size *= S(4)) ++level, side /= 2;
  return level && side <= 2 ? kTileLevels : min_(level, kTileLevels - 1);
}

// Texels on both sides of a position along one axis: `first`, and the next, with weight `fraction`, which is `first`
// again in a tile of one texel. Not `inside`: beyond the outer texel centres, where the position is clamped.
template <class T> struct TexelAxis {
  T first, fraction;
  MaskOf<T> inside;
};
template <class S, class T> BT_HD TexelAxis<T> texel_axis(T u, int r, S extent) {
  const T x = texel_position(u, r, extent), first = min_(floor_(x), T(S(r > 1 ? r - 2 : 0)));
  const MaskOf<T> inside = (x > T(S(0))) & (x < T(S(r - 1)));
  return {first, x - first, inside};
}
// Index steps to the next texel along u and along v; a row of texels runs along u.
struct TexelSteps {
  int right, down;
  BT_HD explicit TexelSteps(const int32_t* size) : right(size[0] > 1 ? 1 : 0), down(size[1] > 1 ? size[0] : 0) {}
};

// Bilinear fetch from four texels t, two rows along u: its weights, value, and slopes along u and v per texel.
template <class S> BT_HD void texel_weights(S fx, S fy, S* weight) {
  weight[0] = (S(1) - fx) * (S(1) - fy), weight[1] = fx * (S(1) - fy), weight[2] = (S(1) - fx) * fy;
  weight[3] = fx * fy;
}
template <class V, class S> BT_HD V texel_mix(const V* t, const S* weight) {
  return (weight[0] * t[0] + weight[1] * t[1]) + (weight[2] * t[2] + weight[3] * t[3]);
}
// Interpolates along u, then along v: exact for equal texels, such as alphas of 1.
template <class S> BT_HD S texel_lerp(const S* t, S fx, S fy) {
  const S above = t[0] + fx * (t[1] - t[0]), below = t[2] + fx * (t[3] - t[2]);
  return above + fy * (below - above);
}
template <class V, class S> BT_HD V texel_slope_u(const V* t, S fy) {
  return (S(1) - fy) * (t[1] - t[0]) + fy * (t[3] - t[2]);
}
template <class V, class S> BT_HD V texel_slope_v(const V* t, S fx) {
  return (S(1) - fx) * (t[2] - t[0]) + fx * (t[3] - t[1]);
}
template <class S> BT_HD S texel_density(int r, S extent) { return S(r) / (S(2) * extent); }

// Texels of one fetch, as offsets from the tile's first.
template <class S> struct TexelCorners {
  int32_t at[4];
  S weight[4];
  S fx, fy;
  bool inside_u, inside_v;
};
template <class S> BT_HD TexelCorners<S> texel_corners(S u, S v, const int32_t* size, S extent) {
  const TexelAxis<S> x = texel_axis(u, size[0], extent), y = texel_axis(v, size[1], extent);
  const TexelSteps next(size);
  TexelCorners<S> c;
  c.at[0] = int32_t(y.first) * size[0] + int32_t(x.first);
  c.at[1] = c.at[0] + next.right, c.at[2] = c.at[0] + next.down, c.at[3] = c.at[2] + next.right;
  texel_weights(x.fraction, y.fraction, c.weight);
  c.fx = x.fraction, c.fy = y.fraction, c.inside_u = x.inside, c.inside_v = y.inside;
  return c;
}

// Tiles of surfels in one list of texels: tile i of r_u x r_v texels starts at first[i]; 0, 0 = no tile.
template <class S> struct Tiles {
  const int64_t* first;  // [n], in texels
  const int32_t* size;   // [n, 2]
  const S* extent;       // [n] half side of the tile, scale units

  template <class R>  // as in ops/arguments.h
  void fields(R& r, int64_t n) {
    r.array("first", first, n);
    r.array("size", size, 2 * n);
    r.array("extent", extent, n);
  }
};
// The tile of one surfel, with C numbers per texel.
template <class S, int C> struct TilePatch {
  const int32_t* size;  // r_u, r_v; 0, 0 = no tile
  const S* tile;        // its texels
  int64_t first;        // index of the first in Tiles
  S extent;

  BT_HD TilePatch(const Tiles<S>& tiles, const S* values, int64_t id)
      : size(tiles.size + 2 * id),
        tile(values + C * tiles.first[id]),
        first(tiles.first[id]),
        extent(tiles.extent[id]) {}
  BT_HD bool textured() const { return size[0] > 0; }
  BT_HD TexelCorners<S> corners(S u, S v) const { return texel_corners(u, v, size, extent); }
};

template <class S> BT_HD void load_corners(const S* tile, const TexelCorners<S>& c, Vec3<S>* t) {
  for (int k = 0; k < 4; ++k) t[k] = load3(tile + 3 * c.at[k]);
}
// Slopes of the fetch along u and v: 0 beyond the outer texel centres; at an inner centre, where the slope jumps, that
// on the side of larger coordinates.
template <class S> struct TexelSlopes {
  Vec3<S> u, v;
};
template <class S>
BT_HD TexelSlopes<S> texel_slopes(const Vec3<S>* t, const TexelCorners<S>& c, const int32_t* size, S extent) {
  TexelSlopes<S> s = {};
  if (c.inside_u) s.u = texel_density(size[0], extent) * texel_slope_u(t, c.fy);
  if (c.inside_v) s.v = texel_density(size[1], extent) * texel_slope_v(t, c.fx);
  return s;
}

// Texel after a step of gradient descent, -rate share g.
template <class V, class S> BT_HD V texel_step(V texel, V g, S rate, S share) { return texel + -rate * share * g; }

}  // namespace bt
