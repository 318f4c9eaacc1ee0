// The CPU kernels: loops over core/ with threads and SIMD. Arrays are dense and row major; nothing here knows Python.
// Every kernel gives the same result however the threads run; the order of summation depends on their number alone.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "core/blend.h"
#include "core/bounds.h"
#include "core/field.h"
#include "core/surfel.h"
#include "core/view_color.h"
#include "cpu/memory.h"

namespace bt {

// `through_pixel` chooses between the kernels of core/surfel.h, and has to be the same wherever a view's rows go.

int num_threads();
void set_num_threads(int n);

// geom [n, kGeom], frames [n, kFrame], radii [n, 2] (half extents of the level-set box in pixels, 0 where not visible),
// rows of surfels that are not visible are zero. Returns how many rows are not finite.
template <class S>
int64_t project_forward(bool through_pixel, const Pinhole<S>& cam, int width, int height, S near, const Surfels<S>& in,
                        S* geom, S* frames, S* radii);
template <class S>
void project_backward(const Pinhole<S>& cam, const Surfels<S>& in, const S* geom, const S* dgeom, const S* dframes,
                      const SurfelGradients<S>& out);

// Per tile, the visible surfels front to back.
struct Bins {
  int tiles_x = 0, tiles_y = 0;
  std::vector<int64_t> start;    // [tiles + 1]
  std::vector<int32_t> surfels;  // [start.back()]
};
template <class S>
void bin(bool through_pixel, int64_t n, const S* geom, const S* radii, int width, int height, Bins& bins);

// The fragments of a view, ordered by tile, then front to back by surfel, then by pixel.
template <class S>
struct FragmentList {
  std::vector<int64_t> tile_start;  // [tiles + 1], in fragments
  int64_t total = 0;
  // Filled by trace, read out by copy. Blocks are large, so that what is not written to takes no memory and what is
  // freed goes back to the operating system. A tile's fragments lie in one block.
  struct Block {
    static constexpr int64_t kSize = int64_t(1) << 21;
    explicit Block(bool first) : memory(allocate(kSize * (2 * sizeof(int32_t) + 5 * sizeof(S)), !first)) {}
    Memory memory;  // small views, which use a part of the first block, do without large pages
    int32_t* surfel = reinterpret_cast<int32_t*>(memory.get());
    int32_t* pixel = surfel + kSize;
    S *weight = reinterpret_cast<S*>(pixel + kSize), *u = weight + kSize, *v = u + kSize, *depth = v + kSize,
      *sigma = depth + kSize;
    int64_t used = 0;
  };
  std::vector<std::vector<Block>> blocks;  // per thread
  struct Piece {
    int thread, block;
    int64_t from, count;
  };
  std::vector<Piece> pieces;  // [tiles]
};
template <class S>
struct FragmentArrays {
  int32_t *surfel, *pixel;
  S *weight, *uv, *depth, *sigma;  // uv [2, F]; sigma is negative in the low-pass branch
};
// Where there are more than `most` (0 = any number) they are only counted.
template <class S>
void trace_forward(bool through_pixel, const S* geom, const S* radii, S near, const Bins& bins, int width, int height,
                   int64_t most, FragmentList<S>& list);
// Large lists give their memory back.
template <class S>
void trace_copy(FragmentList<S>& list, const FragmentArrays<S>& out);

// dgeom [n, kGeom] and absgrad [n, 2] are written. dweight, duv, ddepth may be null (zero).
template <class S>
void trace_backward(bool through_pixel, int64_t n, const S* geom, S near, S rim, int width, const int64_t* tile_start,
                    int64_t tiles, const FragmentArrays<S>& f, const S* dweight, const S* duv, const S* ddepth,
                    S* dgeom, S* absgrad);

// Image [pixels, channels]: the sums of core/blend.h. Written.
template <class S>
void composite_forward(int64_t pixels, bool maps, const S* geom, const int64_t* tile_start, int64_t tiles,
                       const FragmentArrays<S>& f, const S* colors, S* image);
// dweight [F], dcolors [F, 3], ddepth [F] (maps only) and dgeom [n, kGeom] (beta and normal columns) are written.
template <class S>
void composite_backward(int64_t n, bool maps, const S* geom, const int64_t* tile_start, int64_t tiles,
                        const FragmentArrays<S>& f, const S* colors, const S* dimage, S* dweight, S* dcolors, S* ddepth,
                        S* dgeom);

void masked_counts(int64_t fragments, const int32_t* surfel, const int32_t* pixel, const uint8_t* mask,
                   int32_t* counts);

// View colours; center [3]: of the camera. Rows where active is 0 give 0 and get gradient 0.
template <class S>
void view_color_forward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                        const uint8_t* active, S* out);
template <class S>
void lean_color(int64_t n, const LeanColors<S>& p, const S* means, const double* center, const uint8_t* active, S* out);
template <class S>
void view_color_backward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                         const uint8_t* active, const S* dout, const ViewColorArrays<S>& dp, S* dmeans);

// Residual colour field.
template <class S>
void field_forward(int64_t n, const FieldArrays<S>& field, const S* x, S* rho);
// dx may be null. Gradients are written.
template <class S>
void field_backward(int64_t n, const FieldArrays<S>& field, const S* x, const S* drho, const FieldGradients<S>& out,
                    S* dx);

// colors [F, 3] = relu(relu(base + 0.5) + rho(x)); fragments of weight below `bound` keep relu(base + 0.5). field null:
// no residual.
template <class S>
void shade_forward(int64_t fragments, const FragmentArrays<S>& f, S bound, const S* base, const S* frames,
                   const FieldArrays<S>* field, S* colors);
// Written: dbase [n, 3]; and when not null the field's gradients, duv [2, F] and dframes [n, kFrame] (both or neither).
template <class S>
void shade_backward(int64_t n, const int64_t* tile_start, int64_t tiles, const FragmentArrays<S>& f, S bound,
                    const S* base, const S* frames, const FieldArrays<S>* field, const S* colors, const S* dcolors,
                    S* dbase, const FieldGradients<S>* dfield, S* duv, S* dframes);

// Mean SSIM over the valid 11x11 windows of two [height, width, channels] images; da is written when not null.
template <class S>
S ssim(int height, int width, int channels, const S* a, const S* b, S* da);

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
// Texels of all tiles in one list, rows along v: tile i of r_u x r_v texels begins at first[i]; 0, 0 = no tile.
template <class S>
struct TexelTiles {
  const int64_t* first;  // [n], in texels
  const int32_t* size;   // [n, 2]
  const S* extent;       // [n] half side of the tile, scale units
};
template <class S>
struct TexelFragments {
  int64_t count;
  const int32_t *surfel, *pixel;
  const S *weight, *uv;  // uv [2, count]
};
// image [pixels, 3] = sum of w relu(relu(base + 0.5) + texel(u, v)); below `bound` and without a tile w relu(base +
// 0.5)
template <class S>
void texel_image_forward(int64_t pixels, const int64_t* tile_start, int64_t tiles, const TexelFragments<S>& f, S bound,
                         const S* base, const TexelTiles<S>& table, const S* texels, S* image);
// Adds to dtexels [texels, 3] and writes dbase [n, 3]; either may be null. Fragments i with run_start[r] <= i <
// run_start[r + 1] belong to one surfel; `order` sorts the runs by surfel.
template <class S>
void texel_image_backward(int64_t n, const int64_t* run_start, const int64_t* order, int64_t runs,
                          const TexelFragments<S>& f, S bound, const S* base, const TexelTiles<S>& table,
                          const S* texels, const S* dimage, S* dtexels, S* dbase);

// Forward-only renderer of a baked scene.
struct Atlas {
  const Patches& patches;
  float offset, scale;         // residual = offset + scale * stored
  const float* extent;         // [n] half side of the tile, scale units
  float weight_bound;          // fragments of smaller weight get no residual
  float transmittance_min;     // a pixel takes no surfel that would leave it less; 0 = all
  const float* mean_residual;  // [n, 3] of every tile; the residual of a surfel without one
};
// Channels of a baked image: rgb, alpha; with maps those of composite_forward.
constexpr int kBakedChannels = 4;
// image [pixels, channels] is written; overdraw [pixels] int32 or null
template <class S>
void baked_forward(bool through_pixel, const S* geom, const S* radii, S near, const Bins& bins, int width, int height,
                   bool maps, const S* base, const Atlas& atlas, S* image, int32_t* overdraw);

}  // namespace bt
