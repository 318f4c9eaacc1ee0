// Arguments of texels and alpha texels; the alpha of a fragment, and its vector-Jacobian product.
#pragma once

#include "core/blend.h"
#include "core/texel.h"
#include "ops/arguments.h"
#include "ops/field.h"

namespace bt {

template <class S> struct TexelTiles : Tiles<S> {
  int64_t n, texels;
  const S* base;    // [n, 3] f_view
  const S* values;  // [texels, 3]

  template <class R> void fields(R& r) {
    tiles(r);
    r.array("base", base, 3 * n);
  }
  // All but the view colours.
  template <class R> void tiles(R& r) {
    r.rows("first", this->first, n, 1);
    Tiles<S>::fields(r, n);
    r.rows("texels", values, texels, 3);
  }
};
template <class S> struct TexelPatch : TilePatch<S, 3> {
  Vec3<S> view;  // the colour without residual

  BT_HD TexelPatch(const TexelTiles<S>& tiles, int64_t id)
      : TilePatch<S, 3>(tiles, tiles.values, id), view(view_base(load3(tiles.base + 3 * id))) {}
  // Computes the colour of a fragment; texels count from the weight `bound` on.
  BT_HD Vec3<S> color(S weight, S bound, S u, S v) const {
    TexelSlopes<S> none;
    return weight >= bound && this->textured() ? color(this->corners(u, v), false, none) : view;
  }
  BT_HD Vec3<S> color(const TexelCorners<S>& at, bool moves, TexelSlopes<S>& slopes) const {
    Vec3<S> t[4];
    load_corners(this->tile, at, t);
    if (moves) slopes = texel_slopes(t, at, this->size, this->extent);
    return shaded(view, texel_mix(t, at.weight));
  }
};
// Working memory of the backward pass on CUDA: gradient sums of a texel's three channels, and of `squares` or 0.
template <class S> struct TexelWork {
  S* sums;         // [texels, 4]
  int64_t* exact;  // null, or order-independent sums instead of `sums`: [exact_size(...)]

  template <class R> void fields(R& r, int64_t texels) {
    sums = nullptr, exact = nullptr;
    if (r.has("exact_work"))
      r.work("exact_work", exact, exact_size(4 * texels));
    else if (texels)
      r.work("texel_work", sums, 4 * texels);
  }
};

// Alpha texels: the sigma of a fragment whose weight would be at least `bound` is multiplied by the bilinear fetch at
// (u, v) and clamped again; the last bit of its listed v is then 1, else 0. Null `values`: none.
template <class S> struct AlphaTiles : Tiles<S> {
  int64_t texels;
  const S* values;  // [texels], from 0 to 2
  S bound;          // fragments of smaller weight keep their sigma

  template <class R> void fields(R& r, int64_t n) {
    values = nullptr, bound = 0;
    if (!r.has("texel_alpha")) return;
    Tiles<S>::fields(r, n);
    r.rows("texel_alpha", values, texels, 1);
    r.number("alpha_bound", bound);
  }
};

template <class S> struct AlphaPatch : TilePatch<S, 1> {
  BT_HD AlphaPatch(const AlphaTiles<S>& tiles, int64_t id) : TilePatch<S, 1>(tiles, tiles.values, id) {}
  // Fetches m, exactly 1 between texels of 1, and the four texels.
  BT_HD S fetch(const TexelCorners<S>& at, S (&t)[4]) const {
    BT_UNROLL
    for (int k = 0; k < 4; ++k) t[k] = this->tile[at.at[k]];
    return texel_lerp(t, at.fx, at.fy);
  }
};

template <class R, class S>
void check_tiles(R& r, const TexelTiles<S>& table, const AlphaTiles<S>& alpha, int64_t surfels) {
  if (table.n != surfels || (alpha.values && alpha.texels != table.texels))
    r.refuse("the tiles belong to other surfels or other alphas");
}

// Computes the gradient of m and returns it; replaces gs, the gradient of the listed sigma, and that sigma by those of
// the kernel's, and adds to gu and gv. t: the four texels.
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

// Channels of a baked image on the CPU: rgb, alpha; with maps those of BlendForward.
constexpr int kBakedChannels = 4;

// Residual and alpha of n baked surfels.
struct BakedResidual {
  float offset, scale;         // residual = offset + scale * stored
  const float* extent;         // [n] half side of the tile, scale units; null: kSupport everywhere
  const float* mean_residual;  // [n, 3], residual of a surfel without a tile; null: 0
  float alpha_scale;           // m = alpha_scale * stored multiplies sigma, see AlphaTiles; 0: opaque
  const float* mean_alpha;     // [n], m of a surfel without a tile; null: 1
  float weight_bound;          // fragments of smaller weight get neither
  float transmittance_min;     // a pixel ends where less transmittance would be left, see blend_test; 0: never

  template <class R> void fields(R& r, int64_t n) {
    r.numbers("offset", offset, "scale", scale);
    r.maybe("extent", extent, n);
    r.maybe("mean_residual", mean_residual, 3 * n);
    r.number("alpha_scale", alpha_scale);
    r.maybe("mean_alpha", mean_alpha, n);
    r.numbers("weight_bound", weight_bound, "transmittance_min", transmittance_min);
  }
};

}  // namespace bt
