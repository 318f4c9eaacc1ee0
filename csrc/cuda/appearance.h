// View colours of surfels and SSIM of images on CUDA; shapes and meaning as in cpu/kernels.h.
#pragma once

#include "core/view_color.h"
#include "cuda/device.h"

namespace bt::cuda {

template <class S>
void view_color_forward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                        const uint8_t* active, S* out, Stream stream);
template <class S>
void lean_color(int64_t n, const LeanColors<S>& p, const S* means, const double* center, const uint8_t* active, S* out,
                Stream stream);
template <class S>
void view_color_backward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                         const uint8_t* active, const S* dout, const ViewColorArrays<S>& dp, S* dmeans, Stream stream);

// Bytes of working memory.
template <class S>
int64_t ssim_workspace(int height, int width, int channels, bool gradient);
// value [1] and, when not null, da [height, width, channels] are written.
template <class S>
void ssim(int height, int width, int channels, const S* a, const S* b, S* value, S* da, void* workspace, Stream stream);

}  // namespace bt::cuda
