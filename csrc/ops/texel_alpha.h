// Arguments of alpha texels, the alpha of a fragment, and its vector-Jacobian product.
#pragma once

#include "core/blend.h"
#include "core/texel.h"
#include "ops/arguments.h"

namespace bt {

// Alpha texels: the sigma of a fragment whose weight would be at least `bound` is multiplied by the bilinear fetch at
// (u, v) and clamped again; the last bit of its listed v is then 1, else 0. Null `values`: none.
template <class S> struct AlphaTiles {
  int64_t texels;
  const int64_t* first;  // [n], as in TexelTiles
  const int32_t* size;   // [n, 2]
  const S* extent;       // [n]
  const S* values;       // [texels], from 0 to 2
  S bound;               // fragments of smaller weight keep their sigma

  template <class R> void fields(R& r, int64_t n) {
    values = nullptr, bound = 0;
    if (!r.has("texel_alpha")) return;
    r.array("first", first, n);
    r.array("size", size, 2 * n);
    r.array("extent", extent, n);
    r.rows("texel_alpha", values, texels, 1);
    r.number("alpha_bound", bound);
  }
};

// Alpha texels of one surfel.
template <class S> struct AlphaPatch {
  const int32_t* size;  // r_u, r_v; 0, 0 = no tile
  const S* tile;
  int64_t first;
  S extent;

  BT_HD AlphaPatch(const AlphaTiles<S>& tiles, int64_t id)
      : size(tiles.size + 2 * id),
        tile(tiles.values + tiles.first[id]),
        first(tiles.first[id]),
        extent(tiles.extent[id]) {}
  BT_HD bool textured() const { return size[0] > 0; }
  BT_HD TexelCorners<S> corners(S u, S v) const { return texel_corners(u, v, size, extent); }
  // Fetches m, exactly 1 between texels of 1, and the four texels.
  BT_HD S fetch(const TexelCorners<S>& at, S (&t)[4]) const {
    BT_UNROLL
    for (int k = 0; k < 4; ++k) t[k] = tile[at.at[k]];
    return texel_lerp(t, at.fx, at.fy);
  }
};

// Computes the gradients of a fragment's alpha factor: replaces gs, the gradient of the listed sigma, and the listed
// sigma by those of the kernel's, adds to gu and gv, and returns the gradient of m. t: the four texels.
template <class S, class T>
BT_HD T alpha_vjp(const AlphaPatch<S>& patch, const T (&t)[4], const TexelAxis<T>& x, const TexelAxis<T>& y, T& listed,
                  T& gs, T& gu, T& gv) {
  const T m = texel_lerp(t, x.fraction, y.fraction), sigma = abs_(listed), zero = T(S(0));
  // clamped values pass no gradient; m may round differently than when the fragment was written
  const MaskOf<T> moves = sigma < T(S(kAlphaMax)), uncut_moves = moves & (sigma < m * T(S(kAlphaMax * (1 - 1e-6))));
  const T dm = select(moves, gs * sigma / m, zero);
  gu += select(x.inside, dm * T(texel_density(patch.size[0], patch.extent)) * texel_slope_u(t, y.fraction), zero);
  gv += select(y.inside, dm * T(texel_density(patch.size[1], patch.extent)) * texel_slope_v(t, x.fraction), zero);
  gs = select(uncut_moves, gs * m, zero);
  listed = listed / m;
  return dm;
}
template <class S>
BT_HD S alpha_vjp(const AlphaPatch<S>& patch, const TexelCorners<S>& at, S& listed, S& gs, S& gu, S& gv) {
  S t[4];
  patch.fetch(at, t);
  const TexelAxis<S> x = {S(0), at.fx, at.inside_u}, y = {S(0), at.fy, at.inside_v};
  return alpha_vjp(patch, t, x, y, listed, gs, gu, gv);
}

}  // namespace bt
