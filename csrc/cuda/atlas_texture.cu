// Atlas pages on the device; on the host a stand-in with the texture unit's rounding.
#include <stdexcept>

#include "cuda/atlas_texture.h"

#if !defined(__CUDACC__)
#include <cmath>
#include <cstring>
#include <memory>
#endif

namespace bt::cuda {

#if defined(__CUDACC__)

AtlasTexture::AtlasTexture(TexelFormat format, int layers, int height, int width, const void* texels) {
  const bool blocks = format == TexelFormat::kBc7;
  const cudaChannelFormatDesc channels = blocks ? cudaCreateChannelDesc<cudaChannelFormatKindUnsignedBlockCompressed7>()
                                         : format == TexelFormat::kHalf ? cudaCreateChannelDescHalf4()
                                                                        : cudaCreateChannelDesc<uchar4>();
  // a row of blocks is four rows of texels
  const size_t row = blocks ? size_t(width) / 4 * 16 : size_t(width) * (format == TexelFormat::kHalf ? 8 : 4);
  const size_t rows = blocks ? height / 4 : height;
  check(cudaGetDevice(&device_), "current device");
  try {
    for (int layer = 0; layer < layers; ++layer) {
      cudaArray_t page = nullptr;
      check(cudaMallocArray(&page, &channels, width, height), "memory for a page of the atlas");
      pages_.push_back(page);
      const char* from = static_cast<const char*>(texels) + row * rows * layer;
      check(cudaMemcpy2DToArray(page, 0, 0, from, row, row, rows, cudaMemcpyHostToDevice), "copy of the atlas");
      cudaResourceDesc resource = {};
      resource.resType = cudaResourceTypeArray;
      resource.res.array.array = page;
      cudaTextureDesc sampling = {};
      sampling.addressMode[0] = sampling.addressMode[1] = cudaAddressModeClamp;
      sampling.filterMode = cudaFilterModeLinear;
      sampling.readMode = format == TexelFormat::kHalf ? cudaReadModeElementType : cudaReadModeNormalizedFloat;
      sampling.normalizedCoords = 0;
      cudaTextureObject_t texture = 0;
      check(cudaCreateTextureObject(&texture, &resource, &sampling, nullptr), "texture of the atlas");
      handles_.push_back(texture);
    }
    // a copy from pageable memory may still be under way, and streams other than the default one do not wait for it
    check(cudaStreamSynchronize(nullptr), "copy of the atlas");
  } catch (...) {
    release();
    throw;
  }
}
AtlasTexture::~AtlasTexture() { release(); }
void AtlasTexture::release() {
  int current = device_;
  cudaGetDevice(&current);
  cudaSetDevice(device_);
  cudaDeviceSynchronize();  // frames under way still read the pages
  for (uint64_t texture : handles_) cudaDestroyTextureObject(texture);
  for (void* page : pages_) cudaFreeArray(static_cast<cudaArray_t>(page));
  cudaSetDevice(current);
  handles_.clear();
  pages_.clear();
}

#else

namespace {
struct Page {
  int height, width;
  std::vector<float> texels;  // RGBA
};

float from_half(uint16_t h) {
  const int exponent = h >> 10 & 31, mantissa = h & 1023;
  const float sign = h >> 15 ? -1.0f : 1.0f;
  if (exponent == 31) return mantissa ? NAN : sign * INFINITY;
  return sign * (exponent ? std::ldexp(1024.0f + mantissa, exponent - 25) : std::ldexp(float(mantissa), -24));
}
}  // namespace

AtlasTexture::AtlasTexture(TexelFormat format, int layers, int height, int width, const void* texels) {
  if (format == TexelFormat::kBc7)
    throw std::runtime_error("the host has no texture unit: decode the BC7 blocks first");
  const size_t values = size_t(height) * width * 4;
  for (int layer = 0; layer < layers; ++layer) {
    auto page = std::make_unique<Page>(Page{height, width, std::vector<float>(values)});
    for (size_t i = 0; i < values; ++i)
      page->texels[i] = format == TexelFormat::kHalf
                            ? from_half(static_cast<const uint16_t*>(texels)[values * layer + i])
                            : static_cast<const uint8_t*>(texels)[values * layer + i] * (1.0f / 255);
    handles_.push_back(reinterpret_cast<uint64_t>(page.get()));
    pages_.push_back(page.release());
  }
}
AtlasTexture::~AtlasTexture() { release(); }
void AtlasTexture::release() {
  for (void* page : pages_) delete static_cast<Page*>(page);
}

float4 fetch_texel(uint64_t handle, float x, float y) {
  const Page& page = *reinterpret_cast<const Page*>(handle);
  // weights are fixed point with 8 bits of fraction
  const float bx = std::floor(x - 0.5f), by = std::floor(y - 0.5f);
  const float fx = std::floor((x - 0.5f - bx) * 256 + 0.5f) / 256, fy = std::floor((y - 0.5f - by) * 256 + 0.5f) / 256;
  const auto at = [&](float column, float row) {
    const int i = column < 0 ? 0 : column > page.width - 1 ? page.width - 1 : int(column);
    const int j = row < 0 ? 0 : row > page.height - 1 ? page.height - 1 : int(row);
    return page.texels.data() + 4 * (size_t(j) * page.width + i);
  };
  const float *t00 = at(bx, by), *t10 = at(bx + 1, by), *t01 = at(bx, by + 1), *t11 = at(bx + 1, by + 1);
  float c[4];
  for (int i = 0; i < 4; ++i)
    c[i] = (1 - fx) * (1 - fy) * t00[i] + fx * (1 - fy) * t10[i] + (1 - fx) * fy * t01[i] + fx * fy * t11[i];
  return make_float4(c[0], c[1], c[2], c[3]);
}

#endif

}  // namespace bt::cuda
