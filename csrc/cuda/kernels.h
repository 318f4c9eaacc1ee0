// The CUDA kernels as functions of device pointers and a stream. Nothing here allocates, waits for the device or knows
// Python; the caller gives all memory, also the working memory. Shapes are those of cpu/kernels.h unless stated.
#pragma once

#include <cstdint>

#include "core/surfel.h"
#include "cuda/device.h"

namespace bt::cuda {

// viewmat [16] and K [9] lie on the device. geom, frames, radii are written; broken [1] int32 is raised by the number
// of rows that are not finite.
template <class S>
void project_forward(bool through_pixel, const S* viewmat, const S* K, int width, int height, S near,
                     const Surfels<S>& in, S* geom, S* frames, S* radii, int32_t* broken, Stream stream);
// dframes may be null.
template <class S>
void project_backward(const S* viewmat, const S* K, const Surfels<S>& in, const S* geom, const S* dgeom,
                      const S* dframes, const SurfelGradients<S>& out, Stream stream);

}  // namespace bt::cuda
