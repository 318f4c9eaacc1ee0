// Losses, statistics and Adam of a training step, for all surfels and pixels at once; torch would need about fifty
// small operations, whose launches take longer than the operations.
#pragma once

#include "core/blend.h"
#include "cuda/device.h"
#include "ops/arguments.h"

namespace bt::cuda {

// A rendered picture: image [height, width, kImageChannels] of rgb over black, alpha and beta; its photograph target
// [height, width, 3]; mask [height, width], 0 for pixels that do not count, null: all count. background [3] is the
// colour behind the scene, null: black. correction maps the scene's colour to the photograph's, see
// `train.views.View`: gains [3] or matrix and offset [3, 4]; null: none. The losses are those of
// `train.losses.objective`: l1 is the mean of |shown - target|, right that of omega beta, omega = exp(-falloff_gamma
// e), e = |shown - target| summed over rgb. The forward pass leaves in `workspace` what the backward pass reads.
template <class S> struct Picture {
  int height, width, corrected;  // numbers of the correction: 0, 3 or 12
  const S *image, *target, *background, *correction;
  const uint8_t* mask;
  S ssim_weight, falloff_weight, falloff_gamma;
  Workspace workspace;

  BT_HD int64_t pixels() const { return int64_t(height) * width; }
  // All but the image and working memory.
  template <class R> void compared(R& r) {
    r.array("target", target, 3 * pixels());
    r.maybe("mask", mask, pixels());
    r.maybe("background", background, 3);
    r.number("corrected", corrected);
    if (corrected != 0 && corrected != 3 && corrected != 12) r.refuse("a correction has 3 or 12 numbers");
    r.maybe("correction", correction, corrected);
    if (!corrected != !correction) r.refuse("the correction's numbers are missing");
    r.numbers("ssim_weight", ssim_weight, "falloff_weight", falloff_weight, "falloff_gamma", falloff_gamma);
  }
};
template <class S> int64_t picture_workspace(int height, int width);

// Writes photometric = (1 - ssim_weight) l1 + ssim_weight (1 - SSIM) and falloff = falloff_weight times `right` above;
// [1] each.
template <class S> void picture_loss(const Picture<S>& p, S* photometric, S* falloff, Stream stream);

// Writes dimage, and dcorrection unless null, from the gradients of both losses [1]; omega is a constant.
template <class S>
void picture_loss_backward(const Picture<S>& p, const S* dphotometric, const S* dfalloff, S* dimage, S* dcorrection,
                           Stream stream);

// Updates the densification statistics [n] with a view, see `train.strategy.Strategy.accumulate`. grad and absgrad [n,
// 2] are null if nothing was visible.
template <class S> struct DensifyStatistics {
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
template <class S> void accumulate_statistics(const DensifyStatistics<S>& a, Stream stream);

// A parameter of `count` numbers in rows of `width`, and Adam's state of it. The update of a row is multiplied by its
// factor; null: 1. step [1] is the number of steps done.
template <class S> struct AdamParameter {
  S *parameter, *mean, *square;
  float* step;
  const S *gradient, *factors;
  int64_t count, width;
  double rate, beta1, beta2, eps;

  template <class R> void fields(R& r) {
    r.rows("parameter", parameter, count, 1);
    r.arrays(count, "mean", mean, "square", square, "gradient", gradient);
    r.array("step", step, 1);
    r.number("width", width);
    if (width < 1 || count % width) r.refuse("the parameter's rows have another width");
    r.maybe("factors", factors, count / width);
    r.numbers("rate", rate, "beta1", beta1, "beta2", beta2, "eps", eps);
  }
};
// Takes an Adam step on `count` parameters, kAdamParameters of them per launch.
constexpr int kAdamParameters = 16;
template <class S> void adam(const AdamParameter<S>* parameters, int count, Stream stream);

}  // namespace bt::cuda
