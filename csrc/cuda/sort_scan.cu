#include "cuda/sort_scan.h"

#if defined(__CUDACC__)
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#else
#include <algorithm>
#include <numeric>
#include <vector>
#endif

namespace bt::cuda {

#if defined(__CUDACC__)

namespace {
struct Add {
  __device__ int64_t operator()(int64_t a, int64_t b) const { return a + b; }
};
}  // namespace

template <class Key> int64_t sort_workspace(int64_t n, int bits) {
  size_t size = 0;
  const Key* in = nullptr;
  const int32_t* values = nullptr;
  check(cub::DeviceRadixSort::SortPairs(nullptr, size, in, static_cast<Key*>(nullptr), values,
                                        static_cast<int32_t*>(nullptr), int(n), 0, bits),
        "size of the sort's working memory");
  return int64_t(size);
}
template <class Key>
void sort_pairs(const Key* keys, Key* keys_out, const int32_t* values, int32_t* values_out, int64_t n, int bits,
                void* workspace, int64_t workspace_size, Stream stream) {
  if (!n) return;
  size_t size = size_t(workspace_size);
  check(cub::DeviceRadixSort::SortPairs(workspace, size, keys, keys_out, values, values_out, int(n), 0, bits,
                                        static_cast<cudaStream_t>(stream)),
        "sort");
}

int64_t scan_workspace(int64_t n) {
  size_t size = 0;
  check(cub::DeviceScan::ExclusiveScan(nullptr, size, static_cast<const int32_t*>(nullptr),
                                       static_cast<int64_t*>(nullptr), Add(), int64_t(0), int(n)),
        "size of the scan's working memory");
  return int64_t(size);
}
void exclusive_sum(const int32_t* in, int64_t* out, int64_t n, void* workspace, int64_t workspace_size, Stream stream) {
  if (!n) return;
  size_t size = size_t(workspace_size);
  check(cub::DeviceScan::ExclusiveScan(workspace, size, in, out, Add(), int64_t(0), int(n),
                                       static_cast<cudaStream_t>(stream)),
        "scan");
}

#else

template <class Key> int64_t sort_workspace(int64_t, int) { return 1; }
template <class Key>
void sort_pairs(const Key* keys, Key* keys_out, const int32_t* values, int32_t* values_out, int64_t n, int bits, void*,
                int64_t, Stream) {
  const Key mask = bits == int(8 * sizeof(Key)) ? ~Key(0) : (Key(1) << bits) - 1;
  std::vector<int64_t> order(n);
  std::iota(order.begin(), order.end(), int64_t(0));
  std::stable_sort(order.begin(), order.end(),
                   [&](int64_t a, int64_t b) { return (keys[a] & mask) < (keys[b] & mask); });
  for (int64_t i = 0; i < n; ++i) keys_out[i] = keys[order[i]], values_out[i] = values[order[i]];
}

int64_t scan_workspace(int64_t) { return 1; }
void exclusive_sum(const int32_t* in, int64_t* out, int64_t n, void*, int64_t, Stream) {
  int64_t sum = 0;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t value = in[i];
    out[i] = sum;
    sum += value;
  }
}

#endif

#define BT_INSTANTIATE(Key)                           \
  template int64_t sort_workspace<Key>(int64_t, int); \
  template void sort_pairs<Key>(const Key*, Key*, const int32_t*, int32_t*, int64_t, int, void*, int64_t, Stream);
BT_INSTANTIATE(uint32_t)
BT_INSTANTIATE(uint64_t)

}  // namespace bt::cuda
