// Arguments of the residual field at points.
#pragma once

#include "core/field.h"
#include "ops/arguments.h"

namespace bt {

constexpr int kMlpWeights = kInputs * kWidth + kWidth * kWidth + kWidth * 3;  // w1, w2, w3, each input-major
// Blocks of a backward pass on CUDA; fixed, so that sums do not depend on the GPU: four per multiprocessor of an H100.
constexpr int kMostBlocks = 528;

// Sizes in int64 of ExactRange (cuda/warp.h), and of exact sums of `entries` numbers.
constexpr int64_t kExactRange = 2;
constexpr int64_t exact_size(int64_t entries) { return entries + kExactRange; }

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

// dx may be null. Writes the gradients. mlp and exact are working memory on CUDA.
template <class S> struct FieldBackward {
  const FieldArrays<S>* field;
  int64_t n;
  const S *x, *drho;
  FieldGradients<S> dfield;
  S* dx;
  S* mlp;          // [kMostBlocks, kMlpWeights]
  int64_t* exact;  // null, or order-independent sums: [exact_size(entries of the table)]

  template <class R> void fields(R& r) {
    r.object("field", field);
    r.rows("x", x, n, 3);
    r.array("drho", drho, 3 * n);
    dfield.fields(r, *field);
    r.maybe("dx", dx, 3 * n);
    r.work("mlp_work", mlp, int64_t(kMostBlocks) * kMlpWeights);
    r.maybe("exact_work", exact, exact_size(field->table_size()));
  }
};

}  // namespace bt
