// Third stage of the baked renderer: the images.
//
// A warp draws 8 x 8 pixels, two per thread (four rows apart), and works for itself: no barrier of the block, no
// waiting for pixels elsewhere in the tile. It takes the tile's list 32 pairs at a time, keeps those whose mask names
// one of its two parts, gathers 32 of them and loads their rows side by side into shared memory; then every thread
// reads the same row (a broadcast, four loads of 16 bytes) for both its pixels. The three planes cost three
// multiply-adds for the second pixel. On scenes like trained ones 2.5 of a tile's four warps look at a pair, at 4.3 of
// its 8 parts, and 6 of 10 pixels that are looked at blend it: the masks leave little to reject. A hit costs one
// reciprocal, one logarithm, one exponential and, where the weight is above the bound, one texture fetch. Bound by
// issue of arithmetic, then by the texture unit; memory traffic is 96 bytes per row and warp, mostly from L2.
#include "core/kernel.h"
#include "core/shading.h"
#include "core/texel.h"
#include "cuda/atlas_texture.h"
#include "cuda/baked_stages.h"
#include "cuda/fast.h"

namespace bt::cuda {

namespace {
constexpr int kWarps = 4, kThreads = kWarps * kWarp;
constexpr int kRowQuads = kRow / 4;  // float4s of a row
constexpr int kLook = 8;             // rows between looks whether all pixels are done
constexpr int kPixels = 2;           // per thread

struct DrawArgs {
  const float* rows;
  const float4* normals;
  const uint32_t* pairs;
  const int32_t* ranges;
  int width, height, tiles_x, tiles_of_view;
  float near, offset, scale, weight_bound, transmittance_min;
  BakedImages images;
};

struct Pixel {
  float transmittance;  // negative once the pixel takes no more light
  float red, green, blue, beta, depth, nx, ny, nz;
  int count;
};

// A surfel as all threads of a warp read it from shared memory.
struct Row {
  float g[kGeom];
  float r2, blur2, red, green;
  const float4* rest;  // blue, texture
  uint32_t id;
};

// A row under a thread's pixel. With LowPassKernel, kBlur says whether the low pass shows; PixelKernel is for the rows
// that it filters alone.
template <bool kMaps, class Kernel, bool kBlur>
__device__ __forceinline__ void blend(const DrawArgs& a, const Row& s, float dx, float dy, Pixel& p) {
  bool reached = p.transmittance > 0;
  if (!Kernel::kPixel) {  // the planes alone say for most pixels that the surfel is not there
    const Planes<float> at = planes(s.g, dx, dy);
    bool inside = within(at, s.r2) && at.W > 0;
    if (kBlur) inside = inside || dx * dx + dy * dy < s.blur2;
    reached = reached && inside;
  }
  if (!reached) return;
  const Fragment<Fast> f = fragment<Kernel, kBlur>(s.g, a.near, Fast(dx), Fast(dy));
  const float sigma = f.sigma.v;
  const auto [weight, behind] = bt::blend(sigma, p.transmittance);
  const Verdict<float> v = judge(true, sigma, behind, a.transmittance_min);
  if (v.ends) p.transmittance = -p.transmittance;
  if (!v.takes) return;
  p.transmittance = behind;
  const float4 c = s.rest[0];
  float red = s.red, green = s.green, blue = c.x;
  if (weight >= a.weight_bound && c.y != 0) {
    const float4 t = s.rest[1];
    if (c.y > 0) {
      const float x = t.x + texel_position_scaled(f.u.v, t.z, c.y), y = t.y + texel_position_scaled(f.v.v, t.w, c.y);
      uint64_t page;
      const float handle[2] = {c.z, c.w};
      memcpy(&page, handle, sizeof page);
      const float4 texel = fetch_texel(page, x, y);
      red = shaded(red + a.offset, a.scale * texel.x);
      green = shaded(green + a.offset, a.scale * texel.y);
      blue = shaded(blue + a.offset, a.scale * texel.z);
    } else {
      red = t.x, green = t.y, blue = t.z;
    }
  }
  p.red += weight * red, p.green += weight * green, p.blue += weight * blue;
  if (kMaps) {
    p.beta += weight * s.g[kBeta];
    const float4 n = a.normals ? a.normals[s.id] : make_float4(0, 0, 0, 0);
    p.depth += weight * f.depth.v;
    p.nx += weight * n.x, p.ny += weight * n.y, p.nz += weight * n.z;
    ++p.count;
  }
}

// Rounded as the image of floats would be: the product for itself.
__device__ uint32_t to_byte(float x) {
#if defined(__CUDA_ARCH__)
  return uint32_t(__fmul_rn(clamp_(x, 0.0f, 1.0f), 255.0f) + 0.5f);
#else
  return uint32_t(clamp_(x, 0.0f, 1.0f) * 255.0f + 0.5f);
#endif
}

template <bool kMaps>
__device__ void write(const DrawArgs& a, const Pixel& p, int64_t at) {
  const BakedImages& to = a.images;
  const float t = p.transmittance < 0 ? -p.transmittance : p.transmittance;
  float red = p.red, green = p.green, blue = p.blue;
  if (to.background) red += t * to.background[0], green += t * to.background[1], blue += t * to.background[2];
  if (to.rgb) to.rgb[3 * at] = red, to.rgb[3 * at + 1] = green, to.rgb[3 * at + 2] = blue;
  if (to.alpha) to.alpha[at] = 1 - t;
  if (to.packed) to.packed[at] = to_byte(red) | to_byte(green) << 8 | to_byte(blue) << 16 | to_byte(1 - t) << 24;
  if (kMaps) {
    if (to.beta) to.beta[at] = p.beta;
    if (to.depth) to.depth[at] = p.depth;
    if (to.normal) to.normal[3 * at] = p.nx, to.normal[3 * at + 1] = p.ny, to.normal[3 * at + 2] = p.nz;
    if (to.overdraw) to.overdraw[at] = p.count;
  }
}

template <bool kMaps, class Kernel>
__global__ void __launch_bounds__(kThreads, kMaps || Kernel::kPixel ? 6 : 8) draw_kernel(DrawArgs a) {
  __shared__ float4 staged[kWarps][kWarp * kRowQuads];
  __shared__ uint32_t queues[kWarps][2 * kWarp];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const unsigned tile = blockIdx.x;
  const int in_view = int(tile % unsigned(a.tiles_of_view));
  const int x = in_view % a.tiles_x * kTile + (warp & 1) * 8 + (lane & 7);
  const int y = in_view / a.tiles_x * kTile + (warp >> 1) * 8 + (lane >> 3);
  float4* stage = staged[warp];
  uint32_t* queue = queues[warp];
  Pixel p[kPixels];
  uint32_t part[kPixels];  // bit of the part of the tile that holds the thread's pixel
  for (int j = 0; j < kPixels; ++j) {
    p[j] = {x < a.width && y + kBandRows * j < a.height ? 1.0f : -1.0f, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    part[j] = 1u << (2 * ((warp >> 1) * kPixels + j) + (warp & 1));
  }
  uint32_t wanted = 0;  // parts that still take light
  for (int j = 0; j < kPixels; ++j) wanted |= __any_sync(kFullMask, p[j].transmittance > 0) ? part[j] : 0;

  int next = a.ranges ? a.ranges[2 * int64_t(tile)] : 0;
  const int end = a.ranges ? a.ranges[2 * int64_t(tile) + 1] : 0;
  int waiting = 0;  // in the queue
  while (wanted) {
    while (waiting < kWarp && next < end) {
      const uint32_t pair = next + lane < end ? __ldg(a.pairs + next + lane) : 0u;
      const unsigned votes = __ballot_sync(kFullMask, (pair & wanted) != 0);
      if (pair & wanted) queue[waiting + __popc(votes & ((1u << lane) - 1))] = pair;
      waiting += __popc(votes);
      next += kWarp;
    }
    __syncwarp();
    const int taken = min_(waiting, kWarp);
    if (taken == 0) break;
    // three loads in flight: six at once would not fit the registers
    BT_UNROLL_BY(3)
    for (int k = 0; k < kRowQuads; ++k) {
      const int quad = k * kWarp + lane, r = quad / kRowQuads;
      if (r < taken)
        stage[quad] =
            __ldg(reinterpret_cast<const float4*>(a.rows) + int64_t(queue[r] >> 8) * kRowQuads + quad % kRowQuads);
    }
    __syncwarp();
    const float4* q = stage;
    for (int k = 0; k < taken; ++k, q += kRowQuads) {
      if (k % kLook == kLook - 1 && !__any_sync(kFullMask, p[0].transmittance > 0 || p[1].transmittance > 0)) break;
      const float4 q0 = q[0], q1 = q[1], q2 = q[2], q3 = q[3];
      const uint32_t pair = queue[k];
      const float area = Kernel::kPixel && q3.y < 0 ? -q3.y : 0.0f;
      const Row s = {{q0.x, q0.y, q0.z, q0.w, q1.x, q1.y, q1.z, q1.w, q2.x, q2.y, q2.z, q2.w, 0, 0, 0, area},
                     q3.x,
                     q3.y,
                     q3.z,
                     q3.w,
                     q + 4,
                     pair >> 8};
      const float dx = pixel_centre<float>(x) - s.g[kCx], dy = pixel_centre<float>(y) - s.g[kCy];
      BT_UNROLL
      for (int j = 0; j < kPixels; ++j) {
        if (!(pair & part[j])) continue;
        const float below = dy + kBandRows * j;
        if (filtered<Kernel>(s.g))
          blend<kMaps, Kernel, true>(a, s, dx, below, p[j]);
        else if (s.blur2 > 0)
          blend<kMaps, LowPassKernel, true>(a, s, dx, below, p[j]);
        else
          blend<kMaps, LowPassKernel, false>(a, s, dx, below, p[j]);
      }
    }
    wanted = 0;
    for (int j = 0; j < kPixels; ++j) wanted |= __any_sync(kFullMask, p[j].transmittance > 0) ? part[j] : 0;
    waiting -= taken;
    const uint32_t moved = lane < waiting ? queue[kWarp + lane] : 0;
    __syncwarp();
    if (lane < waiting) queue[lane] = moved;
  }
  const int64_t view = tile / unsigned(a.tiles_of_view);
  for (int j = 0; j < kPixels; ++j) {
    const int row = y + kBandRows * j;
    if (x < a.width && row < a.height) write<kMaps>(a, p[j], (view * a.height + row) * a.width + x);
  }
}
}  // namespace

void baked_draw(const BakedScene& s, const BakedImages& images, const BakedFrame& f, Stream stream) {
  if (!f.tiles) return;
  const DrawArgs a = {f.memory.rows,
                      f.memory.normals,
                      f.memory.pairs,
                      f.rows ? f.memory.ranges : nullptr,
                      f.width,
                      f.height,
                      f.tiles_x,
                      f.tiles_x * f.tiles_y,
                      s.near,
                      s.offset,
                      s.scale,
                      s.weight_bound,
                      s.transmittance_min,
                      images};
  const dim3 grid(static_cast<unsigned>(f.tiles));
  const bool maps = images.beta || images.depth || images.normal || images.overdraw;
  with_kernel(f.through_pixel, [&](auto kernel) {
    if (maps)
      BT_LAUNCH((draw_kernel<true, decltype(kernel)>), grid, dim3(kThreads), 0, stream, a);
    else
      BT_LAUNCH((draw_kernel<false, decltype(kernel)>), grid, dim3(kThreads), 0, stream, a);
  });
}

}  // namespace bt::cuda
