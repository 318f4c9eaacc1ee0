// What an operation takes is one struct, the same for its kernels on the CPU and on CUDA. The struct's `fields` names
// each argument once, with its size, to a reader that fills it (bindings/reader.h): it knows nothing of Python.
//
//   r.array(name, pointer, count)      `count` numbers; input where the pointer is to const
//   r.wide(name, pointer, count)       likewise; CUDA kernels read it 16 bytes at a time
//   r.maybe(name, pointer, count)      likewise; null where it was not given
//   r.rows(name, pointer, n, width)    any number n of rows of `width` numbers: n is written
//   r.work(name, pointer, count)       working memory of CUDA kernels; null on the CPU
//   r.memory(name, workspace)          the same as bytes, of which the kernel says how many it needs
//   r.number(name, x), r.choice(name, index, names)
//   r.object(name, pointer), r.maybe_object(name, pointer)    what has a class of its own in Python
//   r.given(name)                      whether the caller gave it
//   r.refuse(why)                      ends the call
#pragma once

#include <cstdint>
#include <stdexcept>

#include "core/bounds.h"

namespace bt {

// Working memory that the caller gives in one block.
struct Workspace {
  void* at;
  int64_t bytes;
  void* of(int64_t needed) const {
    if (bytes < needed) throw std::invalid_argument("the workspace is too small");
    return at;
  }
};

// The fragments of a view, ordered by tile, then front to back by surfel, then as the layout says.
template <class S>
struct FragmentArrays {
  int64_t total;
  int32_t *surfel, *pixel;
  S *weight, *uv, *depth, *sigma;  // uv [2, total]; sigma is negative in the low-pass branch

  // Without `places` surfel and pixel are null: a layout says them.
  template <class R>
  void fields(R& r, bool places = true) {
    r.rows("weight", weight, total, 1);
    r.array("uv", uv, 2 * total);
    r.array("depth", depth, total);
    r.array("sigma", sigma, total);
    surfel = pixel = nullptr;
    if (!places) return;
    r.array("surfel", surfel, total);
    r.array("pixel", pixel, total);
  }
};

inline int64_t tiles_of(int width, int height) { return int64_t(tiles_across(width)) * tiles_across(height); }

// Where the parts of a list begin.
struct TileStarts {
  const int64_t* start;  // [tiles + 1]
  int64_t tiles, fragments;
};
template <class R>
void take(R& r, const char* name, TileStarts& to) {
  r.rows(name, to.start, to.tiles, 1);
  if (--to.tiles < 0 || to.start[0] != 0) r.refuse("the tiles' starts begin with 0");
  to.fragments = to.start[to.tiles];
}

// How kernels of the CPU find their way in a fragment list: those of a surfel in a tile are ordered by packs of 4 x 4
// pixels (cpu/packs.h). Made by trace alone: that packs and fragments belong together is not looked at. CUDA's kernels
// have `Pairs`.
struct TilePacks {
  const int64_t* start;       // [tiles + 1] where each tile's fragments begin
  const int64_t* pack_start;  // [tiles + 1] and where its packs do
  const int32_t* packs;       // [count, 2] what a pack has of a surfel, see PackPart
  int64_t tiles, count, fragments;
  static constexpr int64_t pairs = 0;    // of surfel and tile: not kept
  static constexpr bool kPlaces = true;  // whose all fragments are and where
  bool fits(int64_t, int width, int height) const { return tiles == tiles_of(width, height); }

  template <class R>
  void fields(R& r) {
    TileStarts of = {};
    take(r, "tile_start", of);
    start = of.start, tiles = of.tiles, fragments = of.fragments;
    r.array("pack_start", pack_start, tiles + 1);
    r.rows("packs", packs, count, 2);
    if (pack_start[0] != 0 || pack_start[tiles] != count) r.refuse("the packs do not belong to these tiles");
  }
};
// A layout that is an object of Python.
template <class R, class Layout>
void take(R& r, const char* name, Layout& to) {
  const Layout* given = nullptr;
  r.object(name, given);
  to = *given;
}

// A fragment list with what finds its way in it.
template <class S, class Layout>
struct Fragments {
  Layout layout;
  FragmentArrays<S> f;

  template <class R>
  void fields(R& r, int64_t surfels, int width, int height) {
    take(r, "layout", layout);
    f.fields(r, !Layout::kPlaces);
    if (layout.fragments != f.total || !layout.fits(surfels, width, height))
      r.refuse("the layout does not belong to these fragments");
  }
};

}  // namespace bt
