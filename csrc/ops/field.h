// Arguments of the residual field: at points, at fragments (shading) and at texels.
#pragma once

#include "core/field.h"
#include "core/surfel.h"
#include "ops/arguments.h"

namespace bt {

constexpr int kMlpWeights = kInputs * kWidth + kWidth * kWidth + kWidth * 3;  // w1, w2, w3, each input-major
// Blocks of a backward pass on CUDA: fixed, so that sums do not depend on the card. One round of four blocks on each of
// the 132 multiprocessors of an H100.
constexpr int kMostBlocks = 528;

// Numbers of ExactRange (cuda/field_device.h), and of all that exact sums take: entries of the table (0 when frozen), 3
// per surfel (none for points), and their frames.
constexpr int64_t kExactRange = 5;
constexpr int64_t exact_size(int64_t entries, int64_t surfels, bool frames) {
  return entries + kExactRange + (frames ? 3 + kFrame : 3) * surfels;
}

// Working memory of a backward pass on CUDA.
template <class S> struct FieldWork {
  S* mlp;          // [kMostBlocks, kMlpWeights]
  int64_t* exact;  // null, or for sums that do not depend on the order: [exact_size(...)]

  template <class R> void fields(R& r, bool trains_field, int64_t size) {
    if (trains_field) r.work("mlp_work", mlp, int64_t(kMostBlocks) * kMlpWeights);
    if (r.has("exact_work")) r.work("exact_work", exact, size);
  }
};

template <class S> struct FieldForward {
  const FieldArrays<S>* field;
  int64_t n;
  const S* x;
  S* rho;

  template <class R> void fields(R& r) {
    r.object("field", field);
    r.rows("x", x, n, 3);
    r.array("rho", rho, 3 * n);
  }
};

// dx may be null. Gradients are written.
template <class S> struct FieldBackward {
  const FieldArrays<S>* field;
  int64_t n;
  const S *x, *drho;
  FieldGradients<S> dfield;
  S* dx;
  FieldWork<S> work;

  template <class R> void fields(R& r) {
    r.object("field", field);
    r.rows("x", x, n, 3);
    r.array("drho", drho, 3 * n);
    dfield.fields(r, *field);
    r.maybe("dx", dx, 3 * n);
    work.fields(r, true, exact_size(field->table_size(), 0, false));
  }
};

// colors [F, 3] = relu(relu(base + 0.5) + rho(x)); fragments of weight below `bound` keep relu(base + 0.5). field null:
// no residual.
template <class S> struct ShadeForward {
  FragmentArrays<S> f;
  S bound;
  int64_t n;
  const S *base, *frames;  // [n, 3], [n, kFrame]
  const FieldArrays<S>* field;
  S* colors;

  template <class R> void fields(R& r) {
    f.fields(r);
    r.number("bound", bound);
    r.rows("base", base, n, 3);
    r.array("frames", frames, n * kFrame);
    r.maybe_object("field", field);
    r.array("colors", colors, 3 * f.total);
  }
};

// From the colours of the forward pass and their gradient dbase [n, 3] is written. Where the field learns its
// gradients are written, too; duv [2, F] and dframes [n, kFrame] are null or come together with them.
template <class S> struct ShadeBackward {
  FragmentArrays<S> f;
  S bound;
  int64_t n;
  const S *base, *frames;
  const FieldArrays<S>* field;
  const S *colors, *dcolors;
  S* dbase;
  FieldGradients<S> dfield;
  S *duv, *dframes;
  FieldWork<S> work;

  bool trains_field() const { return field && dfield.table; }
  template <class R> void fields(R& r) {
    f.fields(r);
    r.number("bound", bound);
    r.rows("base", base, n, 3);
    r.array("frames", frames, n * kFrame);
    r.maybe_object("field", field);
    r.arrays(3 * f.total, "colors", colors, "dcolors", dcolors);
    r.array("dbase", dbase, 3 * n);
    if (field && r.has("dtable")) dfield.fields(r, *field);
    r.maybe("duv", duv, 2 * f.total);
    r.maybe("dframes", dframes, n * kFrame);
    if ((duv != nullptr) != (dframes != nullptr) || (duv && !trains_field()))
      r.refuse("duv and dframes come together, with the field's gradients");
    work.fields(r, trains_field(), exact_size(trains_field() ? field->table_size() : 0, n, dframes != nullptr));
  }
};

// The field at the texel centres of n tiles, written into pages [layers, height, width, 3]. tiles [n, 5]: x, y, layer,
// r_u, r_v; first [n + 1]: prefix sum of ceil(r_u r_v / 32) over the tiles, `warps` in all; extent [n]: half side,
// scale units. A value that is not finite is written as 0 and counted in bad [1].
template <class S> struct FieldTiles {
  const FieldArrays<S>* field;
  int64_t n, warps, texels;
  const S *frames, *extent;
  const int32_t* tiles;
  const int64_t* first;
  int width, height;
  S* pages;
  int32_t* bad;

  template <class R> void fields(R& r) {
    r.object("field", field);
    r.rows("extent", extent, n, 1);
    r.array("frames", frames, n * kFrame);
    r.array("tiles", tiles, 5 * n);
    r.array("first", first, n + 1);
    r.numbers("warps", warps, "width", width, "height", height);
    r.rows("pages", pages, texels, 3);
    if (texels % (int64_t(width) * height)) r.refuse("the pages are not width x height x 3");
    r.array("bad", bad, 1);
  }
};

}  // namespace bt
