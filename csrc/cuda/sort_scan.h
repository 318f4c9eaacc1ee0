// Sorting and scanning by CUB, or on the host by plain loops with the same contract.
#pragma once

#include <cstdint>
#include <cstring>

#include "core/common.h"
#include "cuda/device.h"

namespace bt::cuda {

// Unsigned integers ordered like the reals; the largest is no real's key.
template <class S> struct SortKey;
template <> struct SortKey<float> {
  using type = uint32_t;
};
template <> struct SortKey<double> {
  using type = uint64_t;
};
template <class S> BT_HD typename SortKey<S>::type sort_key(S x) {
  using Key = typename SortKey<S>::type;
  constexpr Key top = Key(1) << (8 * sizeof(Key) - 1);
  Key bits;
  memcpy(&bits, &x, sizeof bits);
  return bits & top ? ~bits : bits | top;
}

// Stable sort of (key, value) pairs by the low `bits` bits of the keys. Key: uint32_t or uint64_t; n below
// 2^31.
template <class Key> int64_t sort_workspace(int64_t n, int bits);
template <class Key>
void sort_pairs(const Key* keys, Key* keys_out, const int32_t* values, int32_t* values_out, int64_t n, int bits,
                void* workspace, int64_t workspace_size, Stream stream);

// out[i] = in[0] + ... + in[i - 1], summed in 64 bits; n below 2^31.
int64_t scan_workspace(int64_t n);
void exclusive_sum(const int32_t* in, int64_t* out, int64_t n, void* workspace, int64_t workspace_size, Stream stream);

}  // namespace bt::cuda
