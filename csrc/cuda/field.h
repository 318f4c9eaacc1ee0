// The residual field on CUDA: at points, at the fragments of a view (shading), and at the texels of an atlas.
//
// Work of one look-up with L = 4 levels: 32 entries of 16 bytes gathered from the table (1 KB of 32-byte sectors at
// worst; the table of at most 8 MB stays in the L2), 1,500 operations, of which 1,120 belong to the MLP. An H200
// gathers some 5 TB/s from its L2 and does 60 Tflop/s: 5 look-ups a ns by memory and 40 by arithmetic. The gathers
// decide, and neighbouring fragments that share cells find them in the L1. So a thread does one look-up, with the
// weights in shared memory, read by all lanes at once, 4 multiply-adds a load; tensor cores would round to tf32 and
// gain nothing. The backward pass repeats the look-up, adds 32 times 16 bytes to the table's gradient (one vector
// reduction each, once per run of fragments in one cell where that halves them) and takes 2,240 more operations.
#pragma once

#include "core/field.h"
#include "cuda/pairs.h"

namespace bt::cuda {

constexpr int kMlpWeights = kInputs * kWidth + kWidth * kWidth + kWidth * 3;  // w1, w2, w3, each input-major
constexpr int kMostBlocks = 1024;  // of a backward pass: fixed, so that sums do not depend on the card

// Numbers of ExactRange (field_device.h), and of all that exact sums take: entries of the table (0 when frozen), 3 per
// surfel (none for points), and their frames.
constexpr int64_t kExactRange = 5;
constexpr int64_t exact_size(int64_t entries, int64_t surfels, bool frames) {
  return entries + kExactRange + (frames ? 3 + kFrame : 3) * surfels;
}

// Working memory of a backward pass.
template <class S>
struct FieldWork {
  S* mlp;          // [kMostBlocks, kMlpWeights]
  int64_t* exact;  // null, or for sums that do not depend on the order: [exact_size(...)]
};

template <class S>
void field_forward(int64_t n, const FieldArrays<S>& field, const S* x, S* rho, Stream stream);
// dx may be null. Gradients are written.
template <class S>
void field_backward(int64_t n, const FieldArrays<S>& field, const S* x, const S* drho, const FieldGradients<S>& out,
                    S* dx, const FieldWork<S>& work, Stream stream);

// As in cpu/kernels.h.
template <class S>
void shade_forward(const FragmentArrays<S>& f, S bound, const S* base, const S* frames, const FieldArrays<S>* field,
                   S* colors, Stream stream);
template <class S>
void shade_backward(int64_t n, const FragmentArrays<S>& f, S bound, const S* base, const S* frames,
                    const FieldArrays<S>* field, const S* colors, const S* dcolors, S* dbase,
                    const FieldGradients<S>* dfield, S* duv, S* dframes, const FieldWork<S>& work, Stream stream);

// The field at the texel centres of n tiles, written into pages [layers, height, width, 3]. tiles [n, 5]: x, y, layer,
// r_u, r_v; first [n + 1]: prefix sum of ceil(r_u r_v / 32) over the tiles; extent [n]: half side, scale units. A value
// that is not finite is written as 0 and counted in bad [1].
template <class S>
void bake_tiles(int64_t n, int64_t warps, const FieldArrays<S>& field, const S* frames, const S* extent,
                const int32_t* tiles, const int64_t* first, int width, int height, S* pages, int32_t* bad,
                Stream stream);

}  // namespace bt::cuda
