// Arguments of texels, and the working memory of their gradients.
#pragma once

#include "core/shading.h"
#include "core/texel.h"
#include "ops/arguments.h"
#include "ops/field.h"

namespace bt {

// Texels of all tiles in one list, u fastest: tile i of r_u x r_v texels starts at first[i]; 0, 0 = no tile.
template <class S> struct TexelTiles {
  int64_t n, texels;
  const int64_t* first;  // [n], in texels
  const int32_t* size;   // [n, 2]
  const S* extent;       // [n] half side of the tile, scale units
  const S* base;         // [n, 3] f_view
  const S* values;       // [texels, 3]

  template <class R> void fields(R& r) {
    tiles(r);
    r.array("base", base, 3 * n);
  }
  // All but the view colours.
  template <class R> void tiles(R& r) {
    r.rows("first", first, n, 1);
    r.array("size", size, 2 * n);
    r.array("extent", extent, n);
    r.rows("texels", values, texels, 3);
  }
};
// Texels of one surfel.
template <class S> struct TexelPatch {
  const int32_t* size;  // r_u, r_v; 0, 0 = no tile
  const S* tile;        // its texels
  int64_t first;        // index of the first in TexelTiles
  S extent;
  Vec3<S> view;  // the colour without residual

  BT_HD TexelPatch(const TexelTiles<S>& tiles, int64_t id)
      : size(tiles.size + 2 * id),
        tile(tiles.values + 3 * tiles.first[id]),
        first(tiles.first[id]),
        extent(tiles.extent[id]),
        view(view_base(load3(tiles.base + 3 * id))) {}
  BT_HD bool textured() const { return size[0] > 0; }
  BT_HD TexelCorners<S> corners(S u, S v) const { return texel_corners(u, v, size, extent); }
  // Computes the colour of a fragment; texels count from the weight `bound` on.
  BT_HD Vec3<S> color(S weight, S bound, S u, S v) const {
    TexelSlopes<S> none;
    return weight >= bound && textured() ? color(corners(u, v), false, none) : view;
  }
  BT_HD Vec3<S> color(const TexelCorners<S>& at, bool moves, TexelSlopes<S>& slopes) const {
    Vec3<S> t[4];
    load_corners(tile, at, t);
    if (moves) slopes = texel_slopes(t, at, size, extent);
    return shaded(view, texel_mix(t, at.weight));
  }
};
// Working memory of the backward pass on CUDA: four gradient sums per texel, those of its three channels and that for
// `squares` of BlendBackward, or 0.
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
