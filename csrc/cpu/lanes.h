// Subsets of 16 lanes: masks, and loads and stores to contiguous memory.
#pragma once

#include <array>

#include "cpu/wide.h"

namespace bt {

// Calls fn(lane) for a set of lanes.
template <class F> BT_HD void each_lane(uint32_t lanes, F&& fn) {
  for (; lanes; lanes &= lanes - 1) fn(__builtin_ctz(lanes));
}
// Builds the mask of the lanes with a bit in `lanes`.
template <class M> BT_HD M mask_of_lanes(uint32_t lanes) {
  if constexpr (is_two<M>) {
    constexpr int n = sizeof(M::low) / sizeof(typename M::Lane);
    return {mask_of_lanes<decltype(M::low)>(lanes), mask_of_lanes<decltype(M::high)>(lanes >> n)};
  } else {
    M r;
    for (size_t i = 0; i < sizeof r / sizeof r[0]; ++i) r[i] = lanes >> i & 1 ? -1 : 0;
    return r;
  }
}

#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <> BT_HD MaskOfFloats mask_of_lanes(uint32_t lanes) { return {__mmask16(lanes)}; }
BT_HD __mmask16 first_lanes(uint32_t lanes) { return __mmask16((1u << __builtin_popcount(lanes)) - 1u); }

// Stores the selected lanes contiguously; `to` has room for all lanes of `a`.
BT_HD void compress_lanes(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm512_storeu_ps(to, _mm512_maskz_compress_ps(__mmask16(lanes), (__m512)a));
}
BT_HD void compress_lanes(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(lanes), (__m512i)a));
}
// Stores the selected lanes without writing beyond them.
BT_HD void compress_lanes_only(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm512_mask_storeu_ps(to, first_lanes(lanes), _mm512_maskz_compress_ps(__mmask16(lanes), (__m512)a));
}
BT_HD void compress_lanes_only(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  _mm512_mask_storeu_epi32(to, first_lanes(lanes), _mm512_maskz_compress_epi32(__mmask16(lanes), (__m512i)a));
}
// Loads contiguous memory into the selected lanes, others 0, without reading beyond.
BT_HD void expand_lanes(const float* from, Vector<float>& to, uint32_t lanes) {
  to = (Vector<float>)_mm512_maskz_expand_ps(__mmask16(lanes), _mm512_maskz_loadu_ps(first_lanes(lanes), from));
}
#elif defined(__AVX2__)
BT_HD __m256i mask_of_eight(uint32_t lanes) {
  const __m256i bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
  return _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(int(lanes)), bit), bit);
}
template <> BT_HD MaskOfFloats mask_of_lanes(uint32_t lanes) { return (MaskOfFloats)mask_of_eight(lanes); }
BT_HD __m256i first_lanes(uint32_t lanes) { return mask_of_eight((1u << __builtin_popcount(lanes)) - 1u); }

// Permutations per set of eight lanes, a byte per lane: the selected lanes in order, and its inverse, the rank of each
// lane.
struct LaneOrder {
  std::array<uint64_t, 256> number{}, rank{};
  constexpr LaneOrder() {
    for (int set = 0; set < 256; ++set)
      for (int lane = 0, n = 0; lane < 8; ++lane) {
        rank[set] |= uint64_t(n) << 8 * lane;
        if (set >> lane & 1) number[set] |= uint64_t(lane) << 8 * n++;
      }
  }
};
inline constexpr LaneOrder kLaneOrder;
BT_HD __m256i lane_numbers(uint64_t order) { return _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(int64_t(order))); }
BT_HD __m256 permuted(__m256 a, uint64_t order) { return _mm256_permutevar8x32_ps(a, lane_numbers(order)); }
BT_HD void compress_lanes(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm256_storeu_ps(to, permuted((__m256)a, kLaneOrder.number[lanes]));
}
BT_HD void compress_lanes(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  compress_lanes((float*)to, (Vector<float>)a, lanes);
}
BT_HD void compress_lanes_only(float* to, const Vector<float>& a, uint32_t lanes) {
  _mm256_maskstore_ps(to, first_lanes(lanes), permuted((__m256)a, kLaneOrder.number[lanes]));
}
BT_HD void compress_lanes_only(int32_t* to, const Vector<int32_t>& a, uint32_t lanes) {
  const __m256i next = _mm256_permutevar8x32_epi32((__m256i)a, lane_numbers(kLaneOrder.number[lanes]));
  _mm256_maskstore_epi32(to, first_lanes(lanes), next);
}
BT_HD void expand_lanes(const float* from, Vector<float>& to, uint32_t lanes) {
  const __m256 all = permuted(_mm256_maskload_ps(from, first_lanes(lanes)), kLaneOrder.rank[lanes]);
  to = (Vector<float>)_mm256_and_ps(all, _mm256_castsi256_ps(mask_of_eight(lanes)));
}
#endif

// Calls fn(lanes of the lower half, of the upper half, number in the lower half).
template <class V, class F> BT_HD void by_halves(uint32_t lanes, F&& fn) {
  constexpr int n = sizeof(V::low) / sizeof(typename V::Lane);
  const uint32_t low = lanes & ((1u << n) - 1u);
  fn(low, lanes >> n, __builtin_popcount(low));
}
template <class T, class V> BT_HD void compress_lanes_only(T* to, const V& a, uint32_t lanes) {
  if constexpr (is_two<V>) {
    by_halves<V>(lanes, [&](uint32_t low, uint32_t high, int n) {
      compress_lanes_only(to, a.low, low), compress_lanes_only(to + n, a.high, high);
    });
  } else {
    for (uint32_t k = lanes; k; k &= k - 1) *to++ = a[__builtin_ctz(k)];
  }
}
template <class T, class V> BT_HD void compress_lanes(T* to, const V& a, uint32_t lanes) {
  if constexpr (is_two<V>)
    by_halves<V>(lanes, [&](uint32_t low, uint32_t high, int n) {
      compress_lanes(to, a.low, low), compress_lanes(to + n, a.high, high);
    });
  else
    compress_lanes_only(to, a, lanes);
}
template <class T, class V> BT_HD void expand_lanes(const T* from, V& to, uint32_t lanes) {
  if constexpr (is_two<V>) {
    by_halves<V>(lanes, [&](uint32_t low, uint32_t high, int n) {
      expand_lanes(from, to.low, low), expand_lanes(from + n, to.high, high);
    });
  } else {
    to = V{};
    for (uint32_t k = lanes; k; k &= k - 1) to[__builtin_ctz(k)] = *from++;
  }
}

}  // namespace bt
