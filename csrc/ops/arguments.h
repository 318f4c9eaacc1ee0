// Each operation has one struct of arguments for its CPU and CUDA kernels. Its `fields` names each argument with its
// size to a reader that fills it (bindings/reader.h), independently of Python.
//
//   r.array(name, pointer, count)      `count` numbers; input where the pointer is to const
//   r.wide(name, pointer, count)       likewise; CUDA kernels read it 16 bytes at a time
//   r.maybe(name, pointer, count)      likewise; null if absent
//   r.rows(name, pointer, n, width)    any number n of rows of `width` numbers; n is set
//   r.work(name, pointer, count)       working memory of CUDA kernels; null on the CPU
//   r.memory(name, workspace)          working memory in bytes, as many as the kernel needs
//   r.number(name, x), r.choice(name, index, names)
//   r.numbers(name, x, ...), r.arrays(count, name, pointer, ...), r.maybes(count, name, pointer, ...)
//   r.object(name, pointer), r.maybe_object(name, pointer)    a Python class of its own
//   r.has(name)                        true if passed
//   r.refuse(why)                      raises
#pragma once

#include <cstdint>
#include <stdexcept>

#include "core/bounds.h"

namespace bt {

// Working memory, one block allocated by the caller.
struct Workspace {
  void* at;
  int64_t bytes;
  void* of(int64_t needed) const {
    if (bytes < needed) throw std::invalid_argument("the workspace is too small");
    return at;
  }
};

// Fragments of a view by tile, then front to back by surfel, then by the layout.
template <class S> struct FragmentArrays {
  int64_t total;
  int32_t *surfel, *pixel;
  S *weight, *uv, *depth, *sigma;  // uv [2, total]; sigma is negative in the low-pass branch

  // Without `ids`, surfel and pixel are null and come from the layout.
  template <class R> void fields(R& r, bool ids = true) {
    r.rows("weight", weight, total, 1);
    r.array("uv", uv, 2 * total);
    r.arrays(total, "depth", depth, "sigma", sigma);
    surfel = pixel = nullptr;
    if (!ids) return;
    r.arrays(total, "surfel", surfel, "pixel", pixel);
  }
};

inline int64_t tiles_of(int width, int height) { return int64_t(tiles_across(width)) * tiles_across(height); }

// Offsets of the tiles in a list.
struct TileStarts {
  const int64_t* start;  // [tiles + 1]
  int64_t tiles, fragments;
};
template <class R> void take(R& r, const char* name, TileStarts& to) {
  r.rows(name, to.start, to.tiles, 1);
  if (--to.tiles < 0 || to.start[0] != 0) r.refuse("the tiles' starts begin with 0");
  to.fragments = to.start[to.tiles];
}

// Index of a fragment list on the CPU: within a tile and surfel, fragments are ordered by blocks of 4 x 4 pixels
// (cpu/blocks.h). Blocks and fragments, made by trace, are not checked against each other. CUDA has `Pairs`.
struct TileBlocks {
  const int64_t* start;        // [tiles + 1] first fragment of each tile
  const int64_t* block_start;  // [tiles + 1] first block of each tile
  const int32_t* blocks;       // [count, 2] pixels of a surfel in a block, see BlockPart
  int64_t tiles, count, fragments;
  static constexpr int64_t pairs = 0;    // pairs of surfel and tile are not kept
  static constexpr bool kHasIds = true;  // surfel and pixel of all fragments are known
  bool fits(int64_t, int width, int height) const { return tiles == tiles_of(width, height); }

  template <class R> void fields(R& r) {
    TileStarts of = {};
    take(r, "tile_start", of);
    start = of.start, tiles = of.tiles, fragments = of.fragments;
    r.array("block_start", block_start, tiles + 1);
    r.rows("blocks", blocks, count, 2);
    if (block_start[0] != 0 || block_start[tiles] != count) r.refuse("the blocks do not belong to these tiles");
  }
};
template <class R, class Layout> void take(R& r, const char* name, Layout& to) {
  const Layout* layout = nullptr;
  r.object(name, layout);
  to = *layout;
}

template <class S, class Layout> struct Fragments {
  Layout layout;
  FragmentArrays<S> f;

  template <class R> void fields(R& r, int64_t surfels, int width, int height) {
    take(r, "layout", layout);
    f.fields(r, !Layout::kHasIds);
    if (layout.fragments != f.total || !layout.fits(surfels, width, height))
      r.refuse("the layout does not belong to these fragments");
  }
};

}  // namespace bt
