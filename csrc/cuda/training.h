// Losses and statistics of a training step, for all surfels and pixels at once; torch would need about fifty small
// operations, whose launches take longer than the operations.
#pragma once

#include "core/blend.h"
#include "cuda/device.h"
#include "ops/arguments.h"

namespace bt::cuda {

// image [pixels, kImageChannels]: rgb, alpha and beta; target [pixels, 3]; mask [pixels], 0 for pixels that do not
// count, null: all count. The losses of `train.losses.objective`: l1 is the mean of |rgb - target|, right that of omega
// beta, omega = exp(-gamma e), e = |rgb - target| summed over rgb.
template <class S> struct Picture {
  int64_t pixels;
  const S *image, *target;
  const uint8_t* mask;
  S gamma;

  template <class R> void fields(R& r) {
    r.rows("image", image, pixels, kImageChannels);
    r.array("target", target, 3 * pixels);
    r.maybe("mask", mask, pixels);
    r.numbers("gamma", gamma);
  }
};

// Writes photometric = (1 - share) l1 + share (1 - similarity), falloff = weight right, and counted, the number of
// pixels that count, at least 1; [1] each. sums is working memory.
constexpr int kMostSums = 1024, kLossSums = 3;  // blocks; of l1, right and count
template <class S> struct PictureLoss {
  Picture<S> picture;
  S share, weight;
  const S* similarity;  // [1]
  double* sums;         // [kMostSums, kLossSums]
  S *photometric, *falloff, *counted;

  template <class R> void fields(R& r) {
    picture.fields(r);
    r.numbers("share", share, "weight", weight);
    r.array("similarity", similarity, 1);
    r.array("sums", sums, kLossSums * kMostSums);
    r.arrays(1, "photometric", photometric, "falloff", falloff, "counted", counted);
  }
};
template <class S> void picture_loss(const PictureLoss<S>& a, Stream stream);

// Writes dimage from the gradients of both losses [1] and that of the similarity with respect to rgb [pixels, 3]; omega
// is a constant.
template <class S> struct PictureLossBackward {
  Picture<S> picture;
  S share, weight;
  const S *dsimilarity, *dphotometric, *dfalloff, *counted;
  S* dimage;

  template <class R> void fields(R& r) {
    picture.fields(r);
    r.numbers("share", share, "weight", weight);
    r.array("dsimilarity", dsimilarity, 3 * picture.pixels);
    r.arrays(1, "dphotometric", dphotometric, "dfalloff", dfalloff, "counted", counted);
    r.array("dimage", dimage, picture.pixels * kImageChannels);
  }
};
template <class S> void picture_loss_backward(const PictureLossBackward<S>& a, Stream stream);

// Updates the densification statistics [n] with a view, see `train.strategy.Strategy.accumulate`. grad and absgrad [n,
// 2] are null if nothing was visible.
template <class S> struct NoteCenters {
  int64_t n;
  const S *radii, *grad, *absgrad;
  int width, height;
  float *grad_sum, *abs_grad_sum, *visible_count, *max_radius;

  template <class R> void fields(R& r) {
    r.rows("radii", radii, n, 2);
    r.maybes(2 * n, "grad", grad, "absgrad", absgrad);
    r.numbers("width", width, "height", height);
    r.arrays(n, "grad_sum", grad_sum, "abs_grad_sum", abs_grad_sum, "visible_count", visible_count, "max_radius",
             max_radius);
  }
};
template <class S> void note_centers(const NoteCenters<S>& a, Stream stream);

}  // namespace bt::cuda
