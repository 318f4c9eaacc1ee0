// Visibility and compositing on the device. Nothing here waits: where a count decides an allocation, the caller reads
// the last entry of slot_start or offsets, allocates, and calls the next function.
#pragma once

#include "core/blend.h"
#include "cuda/pairs.h"

namespace bt::cuda {

// Orders the surfels front to back and counts their tiles: order [n] and slot_start [n + 1] are written; the number of
// pairs is slot_start[n].
template <class S>
int64_t bin_count_workspace(int64_t n);
template <class S>
void bin_count(bool through_pixel, int64_t n, const S* geom, const S* radii, int width, int height, int32_t* order,
               int64_t* slot_start, void* workspace, Stream stream);

// Lists the pairs (below 2^31): slot [pairs], surfel [pairs] and tile_pairs [tiles + 1] are written.
int64_t bin_fill_workspace(int64_t pairs, int64_t tiles);
template <class S>
void bin_fill(bool through_pixel, int64_t n, const S* geom, int width, int height, const int32_t* order,
              const int64_t* slot_start, int64_t pairs, int32_t* slot, int32_t* surfel, int64_t* tile_pairs,
              void* workspace, Stream stream);

// Finds which pixels blend which pairs: masks [kTileWarps, pairs], offsets [pairs + 1] and tile_start [tiles + 1] are
// written; the number of fragments is offsets[pairs].
int64_t trace_mark_workspace(int64_t pairs);
template <class S>
void trace_mark(bool through_pixel, const S* geom, const S* radii, S near, int width, int height, int64_t pairs,
                const int32_t* surfel, const int64_t* tile_pairs, uint32_t* masks, int64_t* offsets,
                int64_t* tile_start, void* workspace, Stream stream);
template <class S>
void trace_fill(bool through_pixel, const S* geom, S near, const Pairs& pairs, const FragmentArrays<S>& out,
                Stream stream);

// As bt::trace_backward. dsigma [fragments] and partial [pairs, kTraceSums] are working memory; dweight, duv, ddepth
// may be null. The sums: kShape columns of geom, two absolute gradients, one unused, kArea.
constexpr int kTraceSums = 16;
template <class S>
void trace_backward(bool through_pixel, const S* geom, S near, S rim, const Pairs& pairs, const FragmentArrays<S>& f,
                    const S* dweight, const S* duv, const S* ddepth, S* dsigma, S* partial, S* dgeom, S* absgrad,
                    Stream stream);

// As bt::composite_forward and bt::composite_backward. partial: [pairs, 4] with maps, else [pairs], working memory.
template <class S>
void composite_forward(bool maps, const S* geom, const Pairs& pairs, const FragmentArrays<S>& f, const S* colors,
                       S* image, Stream stream);
template <class S>
void composite_backward(bool maps, const S* geom, const Pairs& pairs, const FragmentArrays<S>& f, const S* colors,
                        const S* dimage, S* partial, S* dweight, S* dcolors, S* ddepth, S* dgeom, Stream stream);

// counts [surfels] is raised by the fragments of each surfel on pixels where mask is not 0.
void masked_counts(const Pairs& pairs, const uint8_t* mask, int32_t* counts, Stream stream);

}  // namespace bt::cuda
