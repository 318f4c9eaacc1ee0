// CPU kernels: loops over core/ with threads and SIMD, independent of Python. Arrays are dense and row major. The order
// of summation depends on the number of threads, not on their scheduling.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "core/bounds.h"
#include "core/texel.h"
#include "cpu/threads.h"
#include "ops/appearance.h"
#include "ops/blend.h"
#include "ops/field.h"
#include "ops/texel.h"
#include "ops/visibility.h"

// Instantiates a kernel, which takes Arguments<S>, for both number types.
#define BT_INSTANTIATE(kernel, Arguments)        \
  template void kernel(const Arguments<float>&); \
  template void kernel(const Arguments<double>&);

namespace bt {

template <class S> void project_forward(const ProjectForward<S>& a);
template <class S> void project_backward(const ProjectBackward<S>& a);

// Visible surfels per tile, front to back, and the squared radii of each surfel's level set, scale units, and of its
// low pass, pixels, 0 where the kernel covers that.
struct Bins {
  Bins() = default;
  Bins(const Bins&) = delete;  // or nanobind would offer copies
  int tiles_x = 0, tiles_y = 0;
  std::vector<int64_t> start;    // [tiles + 1]
  std::vector<int32_t> surfels;  // [start.back()]
  std::vector<float> level;      // [n, 2], of visible surfels
};
template <class S> class Binner {
 public:
  using Aside = std::function<void(int64_t begin, int64_t end)>;
  virtual ~Binner() = default;
  // Called by all threads; then the lists are complete. aside(begin, end): work for all surfels while a thread sorts.
  virtual void run(const Member& m, const Aside& aside) = 0;
};
template <class S> std::unique_ptr<Binner<S>> binner(const View<S>& view, Bins& bins);

// Fragments as found, ordered like FragmentArrays; blocks hold surfels and pixels.
template <class S> struct FoundFragments {
  std::vector<int64_t> tile_start, block_start;  // [tiles + 1]
  int64_t total = 0, blocks = 0;
  // Chunks are large, so that unwritten memory costs nothing and freed memory returns to the system. A tile's fragments
  // lie in one.
  struct Chunk {
    static constexpr int64_t kSize = int64_t(1) << 21;
    explicit Chunk(bool first) : memory(allocate(kSize * (2 * sizeof(int32_t) + 5 * sizeof(S)), !first)) {}
    Memory memory;  // the first chunk has no large pages, as small views use little of it
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
// Memory of a tracer: tile lists and, until copied, fragments.
template <class S> struct Trace {
  Trace() = default;
  Trace(const Trace&) = delete;
  Bins bins;
  FoundFragments<S> list;
};
// Adds what a view shows of its surfels: largest transmittance in front of a blended fragment, and the sums of the
// blending weights from `bound` on, and of all squared blending weights. `bins` is working memory.
template <class S> struct SurfelCoverage {
  View<S> view;
  AlphaTiles<S> alpha;
  S bound;
  Bins* bins;
  S* shown;  // [n, 3]

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    r.number("bound", bound);
    r.object("bins", bins);
    r.array("shown", shown, 3 * view.n);
  }
};
template <class S> void surfel_coverage(const SurfelCoverage<S>& a);

// Adds what a view shows of texels: sums over fragments from the weight `bound` on, at pixels with mask [height, width]
// not 0, of blending weight times bilinear weight, and of squared blending weight times bilinear weight.
template <class S> struct TexelCoverage {
  View<S> view;
  AlphaTiles<S> alpha;
  S bound;
  Bins* bins;
  const int64_t* first;
  const int32_t* size;
  const S* extent;
  const uint8_t* mask;  // null: all pixels count
  int64_t texels;
  S* covered;  // [texels, 2]

  template <class R> void fields(R& r) {
    view.fields(r);
    alpha.fields(r, view.n);
    r.number("bound", bound);
    r.object("bins", bins);
    r.array("covered_first", first, view.n);
    r.array("covered_size", size, 2 * view.n);
    r.array("covered_extent", extent, view.n);
    r.maybe("mask", mask, int64_t(view.width) * view.height);
    r.rows("covered", covered, texels, 2);
  }
};
template <class S> void texel_coverage(const TexelCoverage<S>& a);

// More fragments than `most` (0 = no limit) are only counted.
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
// Writes the list, and the arrays of its TileBlocks.
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
// Large lists free their memory, a chunk of every thread at a time.
template <class S> void trace_copy(const TraceCopy<S>& a, Trace<S>& from);

// Writes surfel and pixel [F] of the fragments of a list.
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

// Selects the fragments with keep [F] not 0; writes their arrays, the starts, and block_start[tiles] blocks.
template <class S> struct SelectBlocks {
  TileBlocks layout;
  const uint8_t* keep;
  FragmentArrays<S> from, out;
  int64_t *tile_start, *block_start;
  int32_t* blocks;

  template <class R> void fields(R& r) {
    take(r, "layout", layout);
    from.fields(r, false);
    if (from.total != layout.fragments) r.refuse("the layout does not belong to these fragments");
    r.array("keep", keep, from.total);
    r.rows("kept_weight", out.weight, out.total, 1);
    r.array("kept_uv", out.uv, 2 * out.total);
    r.arrays(out.total, "kept_depth", out.depth, "kept_sigma", out.sigma);
    r.arrays(layout.tiles + 1, "tile_start", tile_start, "block_start", block_start);
    r.array("blocks", blocks, 2 * layout.count);
  }
};
// Throws std::invalid_argument where `out` has no room for exactly these fragments.
template <class S> void select_fragments(const SelectBlocks<S>& a);

template <class S> void trace_backward(const TraceBackward<S, TileBlocks>& a);
void masked_counts(const MaskedCounts<TileBlocks>& a);

// Throws std::invalid_argument for a surfel with a span outside the terms.
template <class S> void view_color_forward(const ViewColorForward<S>& a);
template <class S> void view_color_backward(const ViewColorBackward<S>& a);

template <class S> void field_forward(const FieldForward<S>& a);
template <class S> void field_backward(const FieldBackward<S>& a);

template <class S> void blend_forward(const BlendForward<S, TileBlocks>& a);
template <class S> void blend_backward(const BlendBackward<S, TileBlocks>& a);
template <class S> void learn_exposure(const LearnExposure<S>& a);
template <class S> void ssim(const Ssim<S>& a);

// An atlas with every surfel's tile contiguous: on pages each row of a tile would cost a cache line and a TLB entry.
struct Patches {
  std::vector<uint8_t> bytes;  // RGBA, or empty
  std::vector<float> floats;   // RGBA, or empty
  std::vector<int64_t> first;  // [n] first texel of a patch
  std::vector<int32_t> sides;  // [n, 2] r_u, r_v; 0: no tile
};
// Pages of an atlas, RGBA.
struct Pages {
  int layers, height, width;
  const uint8_t* bytes;  // [layers, height, width, 4], or null
  const float* floats;   // likewise
  int64_t n;
  const int32_t* tiles;  // [n, 5] x, y, layer, r_u, r_v

  template <class R> void fields(R& r) {
    r.numbers("layers", layers, "height", height, "width", width);
    r.maybes(int64_t(layers) * height * width * 4, "bytes", bytes, "floats", floats);
    r.rows("tiles", tiles, n, 5);
  }
};
// Throws std::invalid_argument for a tile outside its page.
void gather_patches(const Pages& a, Patches& out);
// Renders a baked scene to image [height, width, channels] and, unless null, overdraw [height, width] int32.
template <class S> struct BakedForward {
  View<S> view;
  const S* base;  // [n, 3] f_view
  BakedResidual residual;
  const Patches* patches;
  const Patches* coarser[kTileLevels - 1];  // half and quarter levels of the tiles; null at the photographs' size
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

// The cosine transform of texel blocks, both ways.
constexpr int kCosines = 8;       // texels along a side of the largest block
constexpr int kMostChannels = 3;  // of a texel

// All blocks of one size; coefficients are integer multiples of steps.
template <class S> struct CosineBlocks {
  int64_t texels, tiles, blocks;
  int height, width, channels;  // of a block, at most kCosines each
  const S* mean;                // [tiles, channels], subtracted
  const S* step;                // [tiles]
  const S* mix;                 // [channels, channels] orthonormal transform of the channels
  const S *down, *across;       // [height, height], [width, width] cosine transforms: row k is frequency k
  const int64_t* order;         // [height * width] stored order of coefficients, k_v width + k_u
  const int64_t* tile;          // [blocks]
  const int64_t* rows;          // [blocks, height, width] rows of the texels in `values`

  template <class R> void fields(R& r) {
    r.numbers("height", height, "width", width, "channels", channels);
    if (std::min({height, width, channels}) < 1 || std::max(height, width) > kCosines || channels > kMostChannels)
      r.refuse("blocks have 1 to 8 texels along a side, of 1 to 3 channels");
    r.rows("mean", mean, tiles, channels);
    r.array("step", step, tiles);
    r.array("mix", mix, channels * channels);
    r.array("down", down, height * height);
    r.array("across", across, width * width);
    r.array("order", order, height * width);
    r.rows("tile", tile, blocks, 1);
    r.array("rows", rows, blocks * height * width);
  }
};

// Coefficients c that nearly minimise the sum of weight (t - t(c))^2 + an L1 penalty: `rounds` iterations of ISTA from
// the plain transform.
template <class S> struct SparseCosines : CosineBlocks<S> {
  int rounds;
  S shrink;          // soft threshold relative to the step, for equal weights
  const S* values;   // [texels, channels]
  const S* weights;  // [texels], positive
  int32_t* codes;    // [height * width, blocks, channels]

  template <class R> void fields(R& r) {
    CosineBlocks<S>::fields(r);
    r.number("rounds", rounds);
    r.number("shrink", shrink);
    r.rows("values", values, this->texels, this->channels);
    r.array("weights", weights, this->texels);
    r.array("codes", codes, this->blocks * this->height * this->width * this->channels);
  }
};

// Texels t(c) of the coefficients.
template <class S> struct DecodeCosines : CosineBlocks<S> {
  const int32_t* codes;  // as in `SparseCosines`
  S* values;             // [texels, channels]; rows of other blocks are left

  template <class R> void fields(R& r) {
    CosineBlocks<S>::fields(r);
    r.array("codes", codes, this->blocks * this->height * this->width * this->channels);
    r.rows("values", values, this->texels, this->channels);
  }
};
template <class S> void sparse_cosines(const SparseCosines<S>& a);
template <class S> void decode_cosines(const DecodeCosines<S>& a);

// Minimises, for each of n surfels, the sum over directions of weight |c(d) - target(d)|^2 over the vectors and colours
// of its sites, by Levenberg-Marquardt. c is the mean of the sites' colours, weighted by softmax(vector . d); the first
// site has the vector 0.
template <class S> struct FitSites {
  int64_t n;
  int sites, directions, rounds;
  S *vectors, *colors;  // [n, sites - 1, 3], [n, sites, 3]: the start, replaced by the fit
  const S* samples;     // [n, directions, 7]: unit direction, target colour, weight

  template <class R> void fields(R& r) {
    r.numbers("sites", sites, "directions", directions, "rounds", rounds);
    if (sites < 2 || sites > kMaxTerms) r.refuse("a view colour has 2 to 32 sites");
    r.rows("colors", colors, n, 3 * sites);
    r.array("vectors", vectors, n * 3 * (sites - 1));
    r.array("samples", samples, n * 7 * directions);
  }
};

// Ranks the sites of each of n surfels: while more than one is left, removes the site whose removal changes c least, by
// w / (1 - w) (c - color) for a site of weight w, squared and summed over the directions by their weights.
template <class S> struct RankSites {
  int64_t n;
  int sites, directions;
  const S *vectors, *colors;  // [n, sites, 3] each; weights are softmax(vector . d)
  const S* samples;           // [n, directions, 4]: unit direction, weight
  int64_t* order;             // [n, sites]: the most needed first

  template <class R> void fields(R& r) {
    r.numbers("sites", sites, "directions", directions);
    if (sites < 1 || sites > kMaxTerms) r.refuse("a view colour has 1 to 32 sites");
    r.rows("colors", colors, n, 3 * sites);
    r.array("vectors", vectors, n * 3 * sites);
    r.array("samples", samples, n * 4 * directions);
    r.array("order", order, n * sites);
  }
};
template <class S> void fit_sites(const FitSites<S>& a);
template <class S> void rank_sites(const RankSites<S>& a);

// Entropy coding of integer columns: docs/baking.md, "Columns of integers".

// Layout of a column, a number per row, and what precedes it.
struct IntegerColumn {
  int64_t rows;
  // Number of blocks whose coefficients are the rows: coefficient 0 of every block, then 1, ...; 0 = plain rows.
  int64_t blocks;
  const uint8_t* others;  // [rows] sum of the magnitudes of this row's earlier numbers, at most 2; null without any
};

// Thrown for bytes that no encoder writes.
struct DamagedStream : std::runtime_error {
  using std::runtime_error::runtime_error;
};

constexpr int kIntegerBits = 52;  // of the largest magnitude

std::string encode_integers(const IntegerColumn& column, const int64_t* values);  // [rows]

// Throws DamagedStream.
void decode_integers(const IntegerColumn& column, const uint8_t* data, size_t bytes, int64_t* values);

}  // namespace bt
