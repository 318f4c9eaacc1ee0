// Alpha texels on the device: multiplication of a fragment's sigma, and the mark in v.
#pragma once

#include <cstring>

#include "cuda/device.h"
#include "ops/texel_alpha.h"

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

}  // namespace bt::cuda
