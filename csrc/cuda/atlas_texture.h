// The pages of an atlas as one texture: bilinear, unnormalised coordinates, RGBA as floats in [0, 1] (halves: as
// stored).
#pragma once

#include <cstdint>

#include "cuda/device.h"

namespace bt::cuda {

enum class TexelFormat { kBc7, kUint8, kHalf };
constexpr const char* kTexelFormats[] = {"bc7", "uint8", "half"};

// Returns true if the current device draws BC7 blocks; tested by drawing some. The first call waits for the device.
bool draws_bc7();

// Largest texture on any GPU that the kernels are built for.
constexpr int kMostTextureWidth = 131072, kMostTextureHeight = 65536;

// One texture with all pages, so that its handle is a kernel argument: a handle per surfel would be uniform in a warp,
// but the compiler cannot know and takes sixteen instructions to establish it. Allocates in the constructor. Throws
// std::runtime_error if the device refuses, std::invalid_argument if the texture is too large for any device.
class AtlasTexture {
 public:
  // texels: on the host, [height, width, 4] bytes or halves, or BC7 blocks [height / 4, width / 4, 16].
  AtlasTexture(TexelFormat format, int height, int width, const void* texels);
  ~AtlasTexture();
  AtlasTexture(const AtlasTexture&) = delete;
  AtlasTexture& operator=(const AtlasTexture&) = delete;
  uint64_t handle() const { return handle_; }

 private:
  void release();
  uint64_t handle_ = 0;
  void* texels_ = nullptr;
  int device_ = 0;
};

// Halves a texture to [height, width, 4] means of 2 x 2 texels, as `halved` of ops/baked_scene.py: bytes are rounded,
// with `alpha` colours are weighted by the fourth channel. Halves give floats.
template <class T> struct HalvedTexels {
  const AtlasTexture* texture;
  int height, width;
  bool alpha;
  T* texels;

  template <class R> void fields(R& r) {
    r.object("texture", texture);
    r.numbers("height", height, "width", width, "alpha", alpha);
    r.array("texels", texels, int64_t(4) * height * width);
  }
};
template <class T> void halve_texels(const HalvedTexels<T>& a, Stream stream);

#if defined(__CUDACC__)
__device__ __forceinline__ float4 fetch_texel(uint64_t texture, float x, float y) {
  return tex2D<float4>(static_cast<cudaTextureObject_t>(texture), x, y);
}
#else
float4 fetch_texel(uint64_t texture, float x, float y);
#endif

}  // namespace bt::cuda
