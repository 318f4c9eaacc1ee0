// The CPU kernels: loops over core/ with threads and SIMD. Arrays are dense and row major; nothing here knows Python.
// Every kernel gives the same result however the threads run; the order of summation depends on their number alone.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "core/bounds.h"
#include "core/texel.h"
#include "cpu/memory.h"
#include "cpu/threads.h"
#include "ops/appearance.h"
#include "ops/blend.h"
#include "ops/cosine.h"
#include "ops/field.h"
#include "ops/texel.h"
#include "ops/visibility.h"

namespace bt {

int num_threads();
void set_num_threads(int n);

template <class S> void project_forward(const ProjectForward<S>& a);
template <class S> void project_backward(const ProjectBackward<S>& a);
template <class S> void sparse_cosines(const SparseCosines<S>& a);

// Per tile, the visible surfels front to back, and of each the squared radius of its kernel's
// level set, in scale units, and that of the low pass's in pixels, 0 where that is nowhere above the kernel.
struct Bins {
  Bins() = default;
  Bins(const Bins&) = delete;  // nanobind would else offer copies
  int tiles_x = 0, tiles_y = 0;
  std::vector<int64_t> start;    // [tiles + 1]
  std::vector<int32_t> surfels;  // [start.back()]
  std::vector<float> level;      // [n, 2], of the visible ones
};
// Fills them, by the threads of a team.
template <class S> class Binner {
 public:
  using Aside = std::function<void(int64_t begin, int64_t end)>;
  virtual ~Binner() = default;
  // All of them call it; the lists are there when it returns. aside(begin, end), if any, for all surfels: work of the
  // threads while one of them sorts.
  virtual void run(const Member& m, const Aside& aside) = 0;
};
template <class S> std::unique_ptr<Binner<S>> binner(const View<S>& view, Bins& bins);

// Fragments as they are found, ordered like FragmentArrays; their blocks have surfels and pixels.
template <class S> struct FoundFragments {
  std::vector<int64_t> tile_start, block_start;  // [tiles + 1]
  int64_t total = 0, blocks = 0;
  // Filled by trace, read out by copy. Chunks are large, so that what is not written to takes no memory and what is
  // freed goes back to the operating system. A tile's fragments lie in one chunk.
  struct Chunk {
    static constexpr int64_t kSize = int64_t(1) << 21;
    explicit Chunk(bool first) : memory(allocate(kSize * (2 * sizeof(int32_t) + 5 * sizeof(S)), !first)) {}
    Memory memory;  // small views, which use a part of the first chunk, do without large pages
    int32_t* blocks = reinterpret_cast<int32_t*>(memory.get());
    S *weight = reinterpret_cast<S*>(blocks + 2 * kSize), *u = weight + kSize, *v = u + kSize, *depth = v + kSize,
      *sigma = depth + kSize;
    int64_t used = 0, used_blocks = 0;
  };
  std::vector<std::vector<Chunk>> chunks;  // per thread
  struct Piece {
    int thread, chunk;
    int64_t from, count, from_block, blocks;
  };
  std::vector<Piece> pieces;  // [tiles]
};
// Memory of a tracer: tile lists and, until copied, the fragments.
template <class S> struct Trace {
  Trace() = default;
  Trace(const Trace&) = delete;
  Bins bins;
  FoundFragments<S> list;
};
// More fragments than `most` (0 = any number) are only counted.
template <class S> struct TraceForward {
  View<S> view;
  int64_t most;
  AlphaTiles<S> alpha;

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    r.number("most", most);
  }
};
template <class S> void trace_forward(const TraceForward<S>& a, Trace<S>& to);
// Written: the list, and the arrays of its TileBlocks.
template <class S> struct TraceCopy {
  int64_t starts, blocks_listed;
  int64_t *tile_start, *block_start;
  int32_t* blocks;
  FragmentArrays<S> out;

  template <class R> void fields(R& r) {
    r.rows("tile_start", tile_start, starts, 1);
    r.array("block_start", block_start, starts);
    r.rows("blocks", blocks, blocks_listed, 2);
    out.fields(r, false);
  }
};
// Large lists give their memory back, a chunk of every thread at a time.
template <class S> void trace_copy(const TraceCopy<S>& a, Trace<S>& from);

// Written: surfel and pixel [F] of the fragments of a list.
struct ListedIds {
  TileBlocks layout;
  int width, height;
  int64_t total;
  int32_t *surfel, *pixel;

  template <class R> void fields(R& r) {
    take(r, "layout", layout);
    r.numbers("width", width, "height", height);
    r.rows("surfel", surfel, total, 1);
    r.array("pixel", pixel, total);
    if (layout.fragments != total || !layout.fits(0, width, height)) r.refuse("the layout is not that of such a list");
  }
};
void list_ids(const ListedIds& a);

// The layout of the fragments whose keep [F] is not 0. Written: tile_start, block_start, and as many rows of blocks as
// the last block_start says.
struct SelectBlocks {
  TileBlocks layout;
  const uint8_t* keep;
  int64_t *tile_start, *block_start;
  int32_t* blocks;

  template <class R> void fields(R& r) {
    take(r, "layout", layout);
    r.array("keep", keep, layout.fragments);
    r.arrays(layout.tiles + 1, "tile_start", tile_start, "block_start", block_start);
    r.array("blocks", blocks, 2 * layout.count);
  }
};
void select_fragments(const SelectBlocks& a);

template <class S> void trace_backward(const TraceBackward<S, TileBlocks>& a);
void masked_counts(const MaskedCounts<TileBlocks>& a);

// Throws std::invalid_argument for a surfel whose lean terms are not there.
template <class S> void view_color_forward(const ViewColorForward<S>& a);
template <class S> void view_color_backward(const ViewColorBackward<S>& a);

template <class S> void field_forward(const FieldForward<S>& a);
template <class S> void field_backward(const FieldBackward<S>& a);

template <class S> void blend_forward(const BlendForward<S, TileBlocks>& a);
template <class S> void blend_backward(const BlendBackward<S, TileBlocks>& a);
template <class S> void ssim(const Ssim<S>& a);

// An atlas as the renderer reads it: every surfel's tile in one run, row by row. In pages the rows of a tile lie far
// apart, and each costs a line of the cache and an entry of the page table's.
struct Patches {
  std::vector<uint8_t> bytes;  // RGBA, or empty
  std::vector<float> floats;   // RGBA, or empty
  std::vector<int64_t> first;  // [n] a patch's first texel
  std::vector<int32_t> sides;  // [n, 2] r_u, r_v; 0: no tile
};
// Pages RGBA [layers, height, width, 4] as bytes or floats, the other null; tiles [n, 5]: x, y, layer, r_u, r_v.
// Throws std::invalid_argument for a tile that does not lie on its page.
void gather_patches(int layers, int height, int width, const uint8_t* bytes, const float* floats, int64_t n,
                    const int32_t* tiles, Patches& out);
// The forward-only renderer of a baked scene: image [height, width, channels] is written, overdraw [height, width]
// int32 or null. `bins` is its working memory.
template <class S> struct BakedForward {
  View<S> view;
  const S* base;  // [n, 3] f_view
  BakedResidual residual;
  const Patches* patches;
  const Patches* coarser[kTileLevels - 1];  // the levels of the tiles; null: none, as in views of the photographs' size
  Bins* bins;
  bool maps;
  S* image;
  int32_t* overdraw;

  template <class R> void fields(R& r) {
    view.fields(r);
    r.array("base", base, 3 * view.n);
    residual.fields(r, view.n);
    r.object("patches", patches);
    r.maybe_object("half", coarser[0]);
    r.maybe_object("quarter", coarser[1]);
    for (const Patches* level : {patches, coarser[0], coarser[1]})
      if (level && int64_t(level->first.size()) != view.n) r.refuse("the patches belong to other surfels");
    r.object("bins", bins);
    r.number("maps", maps);
    const int64_t pixels = int64_t(view.width) * view.height;
    r.array("image", image, pixels * (maps ? kMapChannels : kBakedChannels));
    r.maybe("overdraw", overdraw, pixels);
  }
};
template <class S> void baked_forward(const BakedForward<S>& a);

}  // namespace bt
