// The pages of an atlas as textures: bilinear, unnormalised coordinates, RGBA as floats in [0, 1] (halves: as stored).
#pragma once

#include <cstdint>
#include <vector>

#include "cuda/device.h"

namespace bt::cuda {

enum class TexelFormat { kBc7, kUint8, kHalf };

// Whether the current device draws BC7 blocks, found out by drawing some. The first call waits for the device.
bool draws_bc7();

// One texture per page: a handle is 64 bits, the same in a whole warp, and pages are as large as they like. Memory is
// allocated here, once, and freed by the destructor. Throws std::runtime_error when the device refuses.
class AtlasTexture {
 public:
  // texels: on the host, [layers, height, width, 4] bytes or halves, or BC7 blocks [layers, height / 4, width / 4, 16].
  AtlasTexture(TexelFormat format, int layers, int height, int width, const void* texels);
  ~AtlasTexture();
  AtlasTexture(const AtlasTexture&) = delete;
  AtlasTexture& operator=(const AtlasTexture&) = delete;
  const std::vector<uint64_t>& handles() const { return handles_; }

 private:
  void release();
  std::vector<uint64_t> handles_;
  std::vector<void*> pages_;
  int device_ = 0;
};

#if defined(__CUDACC__)
__device__ __forceinline__ float4 fetch_texel(uint64_t page, float x, float y) {
  return tex2D<float4>(static_cast<cudaTextureObject_t>(page), x, y);
}
#else
float4 fetch_texel(uint64_t page, float x, float y);
#endif

}  // namespace bt::cuda
