// Where a surfel coordinate falls in its atlas tile: texel i of r has its centre at u = (i + 0.5) / r * 2 e - e,
// with e the half side of the surfel's tile in scale units (eq. texel centres).
#pragma once

#include <cstdint>

#include "core/surfel.h"

namespace bt {

// Position along one axis of a tile of r texels, clamped to the outer texel centres: texel floor(x), its neighbour
// min(floor(x) + 1, r - 1), and the fraction is the neighbour's weight.
template <class S, class T>
BT_HD T texel_position(T u, int r, S extent) {
  const T x = (u + T(extent)) * T(S(r) / (S(2) * extent)) - T(S(0.5));
  return clamp_(x, T(S(0)), T(S(r - 1)));
}

// The same for a tile of span + 1 texels, with k = 1 / (2 extent) at hand.
template <class S, class T>
BT_HD T texel_position_scaled(T u, S span, S k) {
  return clamp_(u * T((span + S(1)) * k) + T(S(0.5) * span), T(S(0)), T(span));
}

// Levels of a tile: 2 x 2 texels of a level are one of the next, as long as all of that lies on the grid of the page.
constexpr int kTileLevels = 3;
BT_HD bool has_level(const int32_t* tile, int level) {  // x, y, page, r_u, r_v
  return ((tile[0] | tile[1] | tile[3] | tile[4]) & ((1 << level) - 1)) == 0;
}
// The level of which a texel is about as large as a pixel, by a row of geom of core/surfel.h: the geometric mean along
// the axes. Not coarser than a pixel of the view is than one of a photograph: nearer to its size the texels were
// trained as they are. kTileLevels where nothing is left but a constant.
template <class S>
BT_HD int tile_level(const S* g, int r_u, int r_v, S extent, S photo_pixel) {
  const S k = S(0.5) / (extent * g[kW0]);  // texels per pixel along the gradient of u and v, squared
  const S u = g[kU1] * g[kU1] + g[kU2] * g[kU2], v = g[kV1] * g[kV1] + g[kV2] * g[kV2];
  const S area = sqrt_(u * v) * k * k * S(r_u) * S(r_v);  // texels per pixel, by area
  const S most = S(1) / (photo_pixel * photo_pixel);
  int level = 0, side = max_(r_u, r_v);
  // half way between two levels, 4^l sqrt(4) / 2
  for (S size = S(2); level < kTileLevels && area > size && most >= size; size *= S(4)) ++level, side /= 2;
  return level && side <= 2 ? kTileLevels : min_(level, kTileLevels - 1);
}

// Surfel coordinate of the centre of texel i, eq. (texel centres), rounded as bake/texels.py does.
template <class S>
BT_HD S texel_centre(int i, int r, S extent) {
  return extent * (S(2 * i + 1) / S(r) - S(1));
}

// The texels between which the fetch interpolates, as offsets from the tile's first (rows along v), their weights, and
// the position from the first texel's centre, in texels.
template <class S>
struct TexelCorners {
  int64_t at[4];
  S weight[4];
  S x, y;
};
template <class S>
BT_HD TexelCorners<S> texel_corners(S u, S v, int r_u, int r_v, S extent) {
  const S x = texel_position(u, r_u, extent), y = texel_position(v, r_v, extent);
  const int x0 = int(x), y0 = int(y);
  const S fx = x - S(x0), fy = y - S(y0);
  const int64_t corner = int64_t(y0) * r_u + x0, right = x0 + 1 < r_u ? 1 : 0, down = y0 + 1 < r_v ? r_u : 0;
  return {{corner, corner + right, corner + down, corner + down + right},
          {(S(1) - fx) * (S(1) - fy), fx * (S(1) - fy), (S(1) - fx) * fy, fx * fy},
          x,
          y};
}

// Residual colour there, and its vector-Jacobian products: the fetch is linear in the texels, and along u and v between
// texel centres.
template <class S>
BT_HD Vec3<S> texel_fetch(const S* tile, const TexelCorners<S>& c) {
  Vec3<S> sum = c.weight[0] * load3(tile + 3 * c.at[0]);
  for (int k = 1; k < 4; ++k) sum = sum + c.weight[k] * load3(tile + 3 * c.at[k]);
  return sum;
}
// add(k, gradient of corner k).
template <class S, class F>
BT_HD void texel_corner_gradients(const TexelCorners<S>& c, Vec3<S> g, F&& add) {
  for (int k = 0; k < 4; ++k) add(k, c.weight[k] * g);
}
template <class S>
BT_HD void texel_fetch_vjp(const TexelCorners<S>& c, Vec3<S> g, S* dtile) {
  texel_corner_gradients(c, g, [&](int k, Vec3<S> d) { store3(dtile + 3 * c.at[k], load3(dtile + 3 * c.at[k]) + d); });
}
// Adds the gradient with respect to u and v. It is 0 beyond the outer texel centres; at a centre, where the slope
// jumps, it is that of the side of larger coordinates.
template <class S>
BT_HD void texel_fetch_uv_vjp(const S* tile, const TexelCorners<S>& c, int r_u, int r_v, S extent, Vec3<S> g, S& du,
                              S& dv) {
  S along[4];
  for (int k = 0; k < 4; ++k) along[k] = dot(g, load3(tile + 3 * c.at[k]));
  const S fx = c.weight[1] + c.weight[3], fy = c.weight[2] + c.weight[3];
  // of the last texel the neighbour is itself: the difference is 0
  if (c.x > S(0)) du += S(r_u) / (S(2) * extent) * ((S(1) - fy) * (along[1] - along[0]) + fy * (along[3] - along[2]));
  if (c.y > S(0)) dv += S(r_v) / (S(2) * extent) * ((S(1) - fx) * (along[2] - along[0]) + fx * (along[3] - along[1]));
}

// Where a step takes a texel whose gradient is g.
template <class S>
BT_HD Vec3<S> texel_step(Vec3<S> texel, Vec3<S> g, S rate, S share) {
  return texel + -rate * share * g;
}

}  // namespace bt
