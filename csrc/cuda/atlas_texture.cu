// An atlas on the device; on the host an emulation with the texture unit's rounding.
#include <cstring>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include "core/common.h"
#include "cuda/atlas_texture.h"

#if !defined(__CUDACC__)
#include <cmath>
#include <memory>
#endif

namespace bt::cuda {

namespace {
void check_size(int height, int width) {
  if (height > kMostTextureHeight || width > kMostTextureWidth)
    throw std::invalid_argument("the pages of the atlas come to " + std::to_string(width) + " x " +
                                std::to_string(height) + " texels, a texture has " + std::to_string(kMostTextureWidth) +
                                " x " + std::to_string(kMostTextureHeight) + " at most: bake fewer texels");
}

BT_HD void put_mean(const float (&texels)[4], uint8_t& to) {
  int sum = 2;
  for (const float texel : texels) sum += int(texel * 255.0f + 0.5f);
  to = uint8_t(sum / 4);
}
BT_HD void put_mean(const float (&texels)[4], float& to) { to = (texels[0] + texels[1] + texels[2] + texels[3]) / 4; }
// Averages weighted by alpha, of which one is above 0.
BT_HD void put_mean(const float (&texels)[4], const float (&alpha)[4], uint8_t& to) {
  int sum = 0, total = 0;
  for (int k = 0; k < 4; ++k) {
    const int weight = int(alpha[k] * 255.0f + 0.5f);
    sum += weight * int(texels[k] * 255.0f + 0.5f), total += weight;
  }
  to = uint8_t((sum + total / 2) / total);
}
BT_HD void put_mean(const float (&texels)[4], const float (&alpha)[4], float& to) {
  float sum = 0, total = 0;
  for (int k = 0; k < 4; ++k) sum += alpha[k] * texels[k], total += alpha[k];
  to = sum / max_(total, 1e-6f);
}

constexpr int kHalvedThreads = 128;  // per block, along a row of the halved texture
template <class T>
__global__ void __launch_bounds__(kHalvedThreads) halve_kernel(uint64_t texture, int width, bool alpha, T* to) {
  const int x = int(blockIdx.x) * kHalvedThreads + int(threadIdx.x), y = int(blockIdx.y);
  if (x >= width) return;
  float texels[4][4];  // channels of four texels
  for (int k = 0; k < 4; ++k) {
    const float4 c = fetch_texel(texture, float(2 * x + k % 2) + 0.5f, float(2 * y + k / 2) + 0.5f);
    texels[0][k] = c.x, texels[1][k] = c.y, texels[2][k] = c.z, texels[3][k] = c.w;
  }
  const float (&fourth)[4] = texels[3];
  const bool weighted = alpha && (fourth[0] > 0 || fourth[1] > 0 || fourth[2] > 0 || fourth[3] > 0);
  to += 4 * (int64_t(y) * width + x);
  for (int channel = 0; channel < 4; ++channel) {
    if (weighted && channel < 3)
      put_mean(texels[channel], fourth, to[channel]);
    else
      put_mean(texels[channel], to[channel]);
  }
}
}  // namespace

template <class T> void halve_texels(const HalvedTexels<T>& a, Stream stream) {
  if (!a.height || !a.width) return;
  const dim3 blocks(unsigned(ceil_div(a.width, kHalvedThreads)), unsigned(a.height));
  BT_LAUNCH(halve_kernel<T>, blocks, dim3(kHalvedThreads), 0, stream, a.texture->handle(), a.width, a.alpha, a.texels);
}
template void halve_texels(const HalvedTexels<uint8_t>&, Stream);
template void halve_texels(const HalvedTexels<float>&, Stream);

#if defined(__CUDACC__)

namespace {
// Creates the array and its texture; `array` is set as soon as it must be freed.
cudaTextureObject_t make_texture(TexelFormat format, int height, int width, const void* texels, cudaArray_t& array) {
  const bool blocks = format == TexelFormat::kBc7, half = format == TexelFormat::kHalf;
  const cudaChannelFormatDesc channels = blocks
                                             ? cudaCreateChannelDesc<cudaChannelFormatKindUnsignedBlockCompressed7>()
                                             : (half ? cudaCreateChannelDescHalf4() : cudaCreateChannelDesc<uchar4>());
  // a row of blocks is four rows of texels
  const size_t row = blocks ? size_t(width) / 4 * 16 : size_t(width) * (half ? 8 : 4);
  const size_t rows = blocks ? height / 4 : height;
  check(cudaMallocArray(&array, &channels, width, height), "memory for the atlas");
  cudaMemcpy3DParms copy = {};
  copy.srcPtr = make_cudaPitchedPtr(const_cast<void*>(texels), row, width, rows);
  copy.dstArray = array;
  copy.extent = make_cudaExtent(width, height, 1);  // in texels even for blocks (measured; undocumented)
  copy.kind = cudaMemcpyHostToDevice;
  check(cudaMemcpy3D(&copy), "copy of the atlas");
  cudaResourceDesc resource = {};
  resource.resType = cudaResourceTypeArray;
  resource.res.array.array = array;
  cudaTextureDesc sampling = {};
  sampling.addressMode[0] = sampling.addressMode[1] = cudaAddressModeClamp;
  sampling.filterMode = cudaFilterModeLinear;
  sampling.readMode = half ? cudaReadModeElementType : cudaReadModeNormalizedFloat;
  sampling.normalizedCoords = 0;
  cudaTextureObject_t texture = 0;
  check(cudaCreateTextureObject(&texture, &resource, &sampling, nullptr), "texture of the atlas");
  return texture;
}

// Probe: blocks of one colour each, and interpolated texels between them.
constexpr int kProbeWidth = 32, kProbeHeight = 16, kProbeAcross = kProbeWidth / 4;
constexpr int kProbeX = kProbeWidth / 2 - 1, kProbeY = kProbeHeight / 2 - 1;
int probe_red(int block) { return 6 * block + 11; }  // odd, as the last bit of every colour below is 1
// Mode 6: six zeros and a one; both endpoints of red, green, blue and alpha, 7 bits each; both P bits 1; indices 0.
void probe_block(int block, unsigned char* to) {
  const uint64_t red = probe_red(block) >> 1, green = 127 - red, full = 127;
  const uint64_t low =
      1 << 6 | red << 7 | red << 14 | green << 21 | green << 28 | full << 49 | full << 56 | uint64_t(1) << 63;
  const uint64_t high = 1;
  memcpy(to, &low, 8), memcpy(to + 8, &high, 8);
}
__global__ void probe_kernel(uint64_t texture, float4* to) {
  to[blockIdx.x * kProbeX + threadIdx.x] = fetch_texel(texture, 2.0f * threadIdx.x + 2, 2.0f * blockIdx.x + 2);
}
constexpr float kStep = 1.0f / 0xff;  // of 8 bits
void probe() {                        // throws when it does not work
  // four times what is read, in case a driver counts the copy's rows in blocks instead of texels
  std::vector<unsigned char> blocks(4 * kProbeWidth * kProbeHeight);
  for (int i = 0; i < kProbeAcross * kProbeHeight / 4; ++i) probe_block(i, blocks.data() + 16 * i);
  struct Owned {
    cudaArray_t array = nullptr;
    cudaTextureObject_t texture = 0;
    float4* found = nullptr;
    ~Owned() {
      cudaFree(found);
      if (texture) cudaDestroyTextureObject(texture);
      if (array) cudaFreeArray(array);
    }
  } owned;
  owned.texture = make_texture(TexelFormat::kBc7, kProbeHeight, kProbeWidth, blocks.data(), owned.array);
  check(cudaMalloc(&owned.found, kProbeX * kProbeY * sizeof(float4)), "memory for a probe");
  BT_LAUNCH(probe_kernel, dim3(kProbeY), dim3(kProbeX), 0, nullptr, owned.texture, owned.found);
  float4 found[kProbeY][kProbeX];
  check(cudaMemcpy(found, owned.found, sizeof found, cudaMemcpyDeviceToHost), "probe");
  for (int j = 0; j < kProbeY; ++j)
    for (int i = 0; i < kProbeX; ++i) {
      const int x = 2 * i + 2, y = 2 * j + 2;  // corner between four texels
      float red = 0;
      for (int k = 0; k < 4; ++k) red += probe_red((y - k / 2) / 4 * kProbeAcross + (x - k % 2) / 4) * kStep / 4;
      const float4 c = found[j][i];
      const float off =
          fmaxf(fmaxf(fabsf(c.x - red), fabsf(c.y - (1 + kStep - red))), fmaxf(fabsf(c.z - kStep), fabsf(c.w - 1)));
      if (!(off < 1.5f * kStep)) throw std::runtime_error("the texture unit decodes other colours");
    }
}
}  // namespace

bool draws_bc7() {
  static std::map<int, bool> known;
  int device = 0;
  check(cudaGetDevice(&device), "current device");
  const auto at = known.find(device);
  if (at != known.end()) return at->second;
  try {
    probe();
    return known[device] = true;
  } catch (const std::runtime_error&) {
    cudaGetLastError();  // not to be reported by a later call
    return known[device] = false;
  }
}

AtlasTexture::AtlasTexture(TexelFormat format, int height, int width, const void* texels) {
  check_size(height, width);
  if (format == TexelFormat::kBc7 && !draws_bc7())
    throw std::runtime_error("this GPU draws no BC7 textures: decode the blocks first");
  check(cudaGetDevice(&device_), "current device");
  cudaArray_t array = nullptr;
  try {
    handle_ = make_texture(format, height, width, texels, array);
    texels_ = array;
    // a copy from pageable memory may be pending, and only the default stream waits for it
    check(cudaStreamSynchronize(nullptr), "copy of the atlas");
  } catch (...) {
    texels_ = array;
    release();
    throw;
  }
}
AtlasTexture::~AtlasTexture() { release(); }
void AtlasTexture::release() {
  int current = device_;
  cudaGetDevice(&current);
  cudaSetDevice(device_);
  cudaDeviceSynchronize();  // pending frames may still read the texels
  if (handle_) cudaDestroyTextureObject(handle_);
  if (texels_) cudaFreeArray(static_cast<cudaArray_t>(texels_));
  cudaSetDevice(current);
}

#else

bool draws_bc7() { return false; }

namespace {
struct HostTexture {
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

AtlasTexture::AtlasTexture(TexelFormat format, int height, int width, const void* texels) {
  check_size(height, width);
  if (format == TexelFormat::kBc7)
    throw std::runtime_error("the host has no texture unit: decode the BC7 blocks first");
  const size_t values = size_t(height) * width * 4;
  auto texture = std::make_unique<HostTexture>(HostTexture{height, width, std::vector<float>(values)});
  for (size_t i = 0; i < values; ++i)
    texture->texels[i] = format == TexelFormat::kHalf ? from_half(static_cast<const uint16_t*>(texels)[i])
                                                      : static_cast<const uint8_t*>(texels)[i] * (1.0f / 255);
  handle_ = reinterpret_cast<uint64_t>(texture.get());
  texels_ = texture.release();
}
AtlasTexture::~AtlasTexture() { release(); }
void AtlasTexture::release() { delete static_cast<HostTexture*>(texels_); }

float4 fetch_texel(uint64_t handle, float x, float y) {
  const HostTexture& texture = *reinterpret_cast<const HostTexture*>(handle);
  // weights are fixed point with 8 fractional bits
  const float bx = std::floor(x - 0.5f), by = std::floor(y - 0.5f);
  const float fx = std::floor((x - 0.5f - bx) * 256 + 0.5f) / 256, fy = std::floor((y - 0.5f - by) * 256 + 0.5f) / 256;
  const auto at = [&](float column, float row) {
    const int i = column < 0 ? 0 : column > texture.width - 1 ? texture.width - 1 : int(column);
    const int j = row < 0 ? 0 : row > texture.height - 1 ? texture.height - 1 : int(row);
    return texture.texels.data() + 4 * (size_t(j) * texture.width + i);
  };
  const float *t00 = at(bx, by), *t10 = at(bx + 1, by), *t01 = at(bx, by + 1), *t11 = at(bx + 1, by + 1);
  float c[4];
  for (int i = 0; i < 4; ++i)
    c[i] = (1 - fx) * (1 - fy) * t00[i] + fx * (1 - fy) * t10[i] + (1 - fx) * fy * t01[i] + fx * fy * t11[i];
  return make_float4(c[0], c[1], c[2], c[3]);
}

#endif

}  // namespace bt::cuda
