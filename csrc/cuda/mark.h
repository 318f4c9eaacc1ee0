// Front-to-back pass of a tile's block over its pairs, which finds the pixels that blend each.
#pragma once

#include "core/kernel.h"
#include "core/visibility.h"
#include "cuda/fast_float.h"
#include "cuda/fragment_list.h"
#include "cuda/texel_alpha.h"

namespace bt::cuda {

// Returns true if the support or low pass of a surfel without a box may reach the warp's pixels.
template <class S> __device__ bool reached_by_warp(const S* g, const TileThread& s) {
  const S x = S(s.left) + S(0.5 * kWarpWidth) - g[kCx], y = S(s.top) + S(0.5 * kWarpHeight) - g[kCy];
  const Reached<S> r = reached(g, x, y, cell_half(S(0.5 * (kWarpWidth - 1)), g[kCx], abs_(x) + S(kTile)),
                               cell_half(S(0.5 * (kWarpHeight - 1)), g[kCy], abs_(y) + S(kTile)), S(kSupport2),
                               S(kLowPassReach * kLowPassReach));
  return r.support || r.centre;
}

// Writes the masks of a tile's pairs and, with kAlpha and unless null, `cuts`: the fragments whose sigma alpha texels
// multiplied. Calls blended(surfel, g, fragment, weight) for every fragment, in the lane of its pixel. Returns the
// remaining transmittance.
template <bool kAlpha, class S, class Blended>
__device__ __forceinline__ S mark_pairs(const View<S>& view, const AlphaTiles<S>& alpha, int64_t pairs,
                                        const int32_t* surfel, const int64_t* tile_pairs, uint32_t* masks,
                                        uint32_t* cuts, const TileThread& s, Blended&& blended) {
  using T = FastFloatOr<S>;
  const int64_t end = tile_pairs[blockIdx.x + 1];
  int64_t first = tile_pairs[blockIdx.x];
  uint32_t* row = masks + s.warp * pairs;
  const S x = pixel_centre<S>(s.x), y = pixel_centre<S>(s.y);
  bool open = s.x < view.width && s.y < view.height;  // the pixel is not ended
  S transmittance = S(1);
  for (; first < end && __any_sync(kFullMask, open); first += kWarp) {
    // one lane per pair: does its box meet the warp's pixels, or without a box, does it reach them?
    const int64_t own = first + s.lane;
    int32_t id = 0;
    bool meets = false;
    if (own < end) {
      id = surfel[own];
      const S* g = view.geom + int64_t(id) * kGeom;
      const S rx = view.radii[2 * int64_t(id)], ry = view.radii[2 * int64_t(id) + 1];
      // the centre of a disc without a box may lie beyond its radii
      if (max_(rx, ry) >= S(kBoxless))
        meets = reached_by_warp(g, s);
      else
        meets = g[kCx] + rx >= S(s.left) && g[kCx] - rx <= S(s.left + kWarpWidth) && g[kCy] + ry >= S(s.top) &&
                g[kCy] - ry <= S(s.top + kWarpHeight);
    }
    unsigned todo = __ballot_sync(kFullMask, meets);
    uint32_t mark = 0, cut_mark = 0;
    while (todo) {
      const int j = take_first(todo);
      S g[kGeom];
      const int64_t drawn = __shfl_sync(kFullMask, id, j);
      load_shape(view.geom + drawn * kGeom, g);
      const T dx = T(x - g[kCx]), dy = T(y - g[kCy]);
      // a cheap test first: any open pixel in the support or near the centre
      const bool close = near_centre(dx, dy);
      if (!__any_sync(kFullMask, open && (close || in_support(planes<S, T>(g, dx, dy))))) continue;
      const Fragment<T> f = fragment<LowPassKernel>(g, view.near, dx, dy, __any_sync(kFullMask, close));
      S sigma = plain(f.sigma);
      bool is_cut = false;
      if constexpr (kAlpha) {
        S v = plain(f.v);
        if (open && sigma >= S(kAlphaMin)) is_cut = cut(alpha, drawn, transmittance, plain(f.u), v, sigma);
      }
      const Blend<S> b = blend(sigma, transmittance);
      const BlendTest<S> test = blend_test(open, sigma, b.behind, S(kTransmittanceMin));
      open = open && !test.ends;
      if (test.takes) {
        transmittance = b.behind;
        blended(drawn, g, f, b.weight);
      }
      const unsigned taken = __ballot_sync(kFullMask, test.takes);
      if (s.lane == j) mark = taken;
      if constexpr (kAlpha) {
        const unsigned were_cut = cuts ? __ballot_sync(kFullMask, test.takes && is_cut) : 0;
        if (s.lane == j) cut_mark = were_cut;
      }
      if (!__any_sync(kFullMask, open)) todo = 0;
    }
    if (own < end) {
      row[own] = mark;
      if (kAlpha && cuts) cuts[s.warp * pairs + own] = cut_mark;
    }
  }
  for (int64_t k = first + s.lane; k < end; k += kWarp) row[k] = 0;
  return transmittance;
}

}  // namespace bt::cuda
