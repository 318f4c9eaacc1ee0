// Front-to-back pass of a tile's block over its pairs, which finds the pixels that blend each.
#pragma once

#include <cstring>

#include "core/kernel.h"
#include "core/visibility.h"
#include "cuda/fast_float.h"
#include "cuda/kernels.h"

namespace bt::cuda {

// v with the last mantissa bit set or cleared, which marks a multiplied sigma.
template <class S> using BitsOf = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;
template <class S> __device__ BitsOf<S> bits_of(S v) {
  BitsOf<S> bits;
  memcpy(&bits, &v, sizeof bits);
  return bits;
}
template <class S> __device__ bool is_marked(S v) { return bits_of(v) & 1; }
template <class S> __device__ S with_mark(S v, bool mark) {
  const BitsOf<S> bits = (bits_of(v) & ~BitsOf<S>(1)) | BitsOf<S>(mark);
  memcpy(&v, &bits, sizeof bits);
  return v;
}

// Multiplies the sigma (>= 1/255) of a surfel's fragment if its weight would be at least the bound, and marks v;
// returns whether it did. Shared by both passes over a view, so that they agree.
template <class S> __device__ bool cut(const AlphaTiles<S>& tiles, int64_t id, S transmittance, S u, S& v, S& sigma) {
  const AlphaPatch<S> patch(tiles, id);
  if (!patch.textured()) return false;
  const bool reaches = blend(sigma, transmittance).weight >= tiles.bound;
  v = with_mark(v, reaches);
  if (!reaches) return false;
  S t[4];
  sigma = alpha_cut(sigma, patch.fetch(patch.corners(u, v), t));
  return true;
}

// Returns true if the support or low pass of a surfel without a box may reach the warp's pixels.
template <class S> __device__ bool reached_by_warp(const S* g, const TileThread& s) {
  const S x = S(s.left) + S(0.5 * kWarpWidth) - g[kCx], y = S(s.top) + S(0.5 * kWarpHeight) - g[kCy];
  const Reached<S> r = reached(g, x, y, cell_half(S(0.5 * (kWarpWidth - 1)), g[kCx], abs_(x) + S(kTile)),
                               cell_half(S(0.5 * (kWarpHeight - 1)), g[kCy], abs_(y) + S(kTile)), S(kSupport2),
                               S(kLowPassReach * kLowPassReach));
  return r.support || r.centre;
}

// Writes the masks of a tile's pairs and, with kAlpha and unless null, `cuts`. Calls blended(surfel, g, fragment,
// weight) for every fragment, in the lane of its pixel. Returns the remaining transmittance.
template <bool kAlpha, class S, class Blended>
__device__ __forceinline__ S mark_pairs(const MarkedView<S>& a, const TileThread& s, Blended&& blended) {
  using T = FastFloatOr<S>;
  const View<S>& view = a.view;
  const int64_t end = a.tile_pairs[blockIdx.x + 1];
  int64_t first = a.tile_pairs[blockIdx.x];
  uint32_t* row = a.masks + s.warp * a.pairs;
  const S x = pixel_centre<S>(s.x), y = pixel_centre<S>(s.y);
  bool open = s.x < view.width && s.y < view.height;  // the pixel is not ended
  S transmittance = S(1);
  for (; first < end && __any_sync(kFullMask, open); first += kWarp) {
    // one lane per pair: does its box meet the warp's pixels, or without a box, does it reach them?
    const int64_t own = first + s.lane;
    int32_t id = 0;
    bool meets = false;
    if (own < end) {
      id = a.surfel[own];
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
        if (open && sigma >= S(kAlphaMin)) is_cut = cut(a.alpha, drawn, transmittance, plain(f.u), v, sigma);
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
        const unsigned were_cut = a.cuts ? __ballot_sync(kFullMask, test.takes && is_cut) : 0;
        if (s.lane == j) cut_mark = were_cut;
      }
      if (!__any_sync(kFullMask, open)) todo = 0;
    }
    if (own < end) {
      row[own] = mark;
      if (kAlpha && a.cuts) a.cuts[s.warp * a.pairs + own] = cut_mark;
    }
  }
  for (int64_t k = first + s.lane; k < end; k += kWarp) row[k] = 0;
  return transmittance;
}

}  // namespace bt::cuda
