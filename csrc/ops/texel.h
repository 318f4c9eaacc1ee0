// Arguments of the images and colours that texels give, and of their gradients.
#pragma once

#include "core/shading.h"
#include "core/texel.h"
#include "ops/arguments.h"
#include "ops/field.h"

namespace bt {

// Texels of all tiles in one list, rows along v: tile i of r_u x r_v texels begins at first[i]; 0, 0 = no tile.
template <class S>
struct TexelTiles {
  int64_t n, texels;
  const int64_t* first;  // [n], in texels
  const int32_t* size;   // [n, 2]
  const S* extent;       // [n] half side of the tile, scale units
  const S* base;         // [n, 3] f_view
  const S* values;       // [texels, 3]

  template <class R>
  void fields(R& r) {
    r.rows("first", first, n, 1);
    r.array("size", size, 2 * n);
    r.array("extent", extent, n);
    r.array("base", base, 3 * n);
    r.rows("texels", values, texels, 3);
  }
};
// A backward pass that moves texels, those that it reads or others in their stead, moves them by a share of each and
// keeps no gradient of them.
template <class R, class S>
void check_moved(R& r, const S* moved, const S* share, const S* dtexels) {
  if (moved && (!share || dtexels)) r.refuse("texels move by a share of each, and their gradient is not kept");
}
// What the fragments of one surfel share.
template <class S>
struct TexelPatch {
  const int32_t* size;  // r_u, r_v; 0, 0 = no tile
  const S* tile;        // its texels
  int64_t first;        // of them
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
  BT_HD Vec3<S> color(const TexelCorners<S>& at) const { return shaded(view, texel_fetch(tile, at)); }
  // adds the gradient with respect to u and v
  BT_HD void uv_vjp(const TexelCorners<S>& at, Vec3<S> g, S& du, S& dv) const {
    Vec3<S> t[4];
    load_corners(tile, at, t);
    const TexelSlopes<S> slopes = texel_slopes(t, at, size, extent);
    du += dot(g, slopes.u), dv += dot(g, slopes.v);
  }
};
template <class S>
struct TexelFragments {
  int64_t count;
  const int32_t *surfel, *pixel;
  const S *weight, *uv;  // uv [2, count]

  template <class R>
  void fields(R& r, const char* name, TileStarts& starts) {
    r.rows("surfel", surfel, count, 1);
    r.array("pixel", pixel, count);
    r.array("weight", weight, count);
    r.array("uv", uv, 2 * count);
    take(r, name, starts);
    if (starts.fragments != count) r.refuse("the starts do not belong to these fragments");
  }
};

// image [pixels, 3] = sum of w relu(relu(base + 0.5) + texel(u, v)); below `bound` and without a tile w relu(base +
// 0.5)
template <class S>
struct TexelForward {
  TexelFragments<S> f;
  TileStarts layout;  // of the screen's tiles
  S bound;
  TexelTiles<S> table;
  int64_t pixels;
  S* image;

  template <class R>
  void fields(R& r) {
    f.fields(r, "tile_start", layout);
    r.number("bound", bound);
    table.fields(r);
    r.rows("image", image, pixels, 3);
  }
};
// Adds to dtexels [texels, 3] and writes dbase [n, 3]; either may be null. Fragments i with run_start[r] <= i <
// run_start[r + 1] belong to one surfel; `order` sorts the runs by surfel.
template <class S>
struct TexelBackward {
  TexelFragments<S> f;
  TileStarts runs;
  const int64_t* order;
  S bound;
  TexelTiles<S> table;
  int64_t pixels;
  const S* dimage;
  S *dtexels, *dbase;

  template <class R>
  void fields(R& r) {
    f.fields(r, "run_start", runs);
    r.array("order", order, runs.tiles);
    r.number("bound", bound);
    table.fields(r);
    r.rows("dimage", dimage, pixels, 3);
    r.maybe("dtexels", dtexels, 3 * table.texels);
    r.maybe("dbase", dbase, 3 * table.n);
  }
};

// What the colours of fragments are made of.
template <class S>
struct TexelColors {
  FragmentArrays<S> f;
  S bound;
  TexelTiles<S> table;

  template <class R>
  void fields(R& r) {
    f.fields(r);
    r.number("bound", bound);
    table.fields(r);
  }
};
// colors [F, 3] = relu(relu(base + 0.5) + texel(u, v)); below `bound` and without a tile relu(base + 0.5)
template <class S>
struct TexelColorsForward {
  TexelColors<S> of;
  S* colors;

  template <class R>
  void fields(R& r) {
    of.fields(r);
    r.array("colors", colors, 3 * of.f.total);
  }
};
// Working memory of the backward pass on CUDA: where the texels' gradients are added up, rows of four, the last 0.
template <class S>
struct TexelWork {
  S* sums;         // [texels, 4]
  int64_t* exact;  // null, or in its place for sums that do not depend on the order: [exact_size(...)]

  template <class R>
  void fields(R& r, int64_t texels, int64_t surfels) {
    sums = nullptr, exact = nullptr;
    if (r.given("exact_work"))
      r.work("exact_work", exact, exact_size(4 * texels, surfels, false));
    else if (texels)
      r.work("texel_work", sums, 4 * texels);
  }
};
// Writes dbase [n, 3], dtexels [texels, 3] and duv [2, F]; each may be null. With `moved`, the texels themselves, their
// gradient g is not kept: every texel moves by -rate `share` [texels] g.
template <class S>
struct TexelColorsBackward {
  TexelColors<S> of;
  const S *colors, *dcolors;
  const S* share;
  S rate;
  S *dbase, *dtexels, *duv, *moved;
  TexelWork<S> work;

  bool sums_texels() const { return dtexels || moved; }
  template <class R>
  void fields(R& r) {
    of.fields(r);
    r.array("colors", colors, 3 * of.f.total);
    r.array("dcolors", dcolors, 3 * of.f.total);
    r.maybe("dbase", dbase, 3 * of.table.n);
    r.maybe("dtexels", dtexels, 3 * of.table.texels);
    r.maybe("duv", duv, 2 * of.f.total);
    r.maybe("moved", moved, 3 * of.table.texels);
    r.maybe("share", share, of.table.texels);
    r.number("rate", rate);
    work.fields(r, sums_texels() ? of.table.texels : 0, of.table.n);
    check_moved(r, moved, share, dtexels);
  }
};

}  // namespace bt
