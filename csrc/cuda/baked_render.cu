// Second stage of the baked renderer: images.
//
// The block of a tile sorts its list. Then each warp draws 8 x 8 pixels, two per thread (four rows apart),
// independently of the others. It takes the tile's list 32 pairs at a time and keeps those whose mask has one of its
// two parts. When it has 32, it loads their rows into shared memory. Every thread then reads the same row (a broadcast,
// four loads of 16 bytes) and evaluates both its pixels together.
//
// On scenes like trained ones 2.5 of a tile's four warps examine a pair, in 4.3 of its 8 parts, and 6 of 10 examined
// pixels blend it, so the masks leave little to reject. A hit costs one reciprocal, one logarithm, one exponential and,
// above the weight bound, one texture fetch. The kernel is bound by arithmetic issue, then by the texture unit. Memory
// traffic is 96 bytes per row and warp, mostly from L2.
#include <type_traits>

#include "core/blend.h"
#include "core/kernel.h"
#include "core/texel.h"
#include "cuda/atlas_texture.h"
#include "cuda/baked_sort.h"
#include "cuda/fast_float.h"

namespace bt::cuda {

namespace {
constexpr int kPixels = 2;  // per thread; with one, frames take 6 to 33 % longer on an H100
constexpr int kWarps = 2 * kBands / kPixels, kThreads = kWarps * kWarp;
static_assert(kThreads == kDrawThreads);
constexpr int kRowQuads = kRow / 4;  // float4s of a row
constexpr int kCheckEvery = 8;       // rows between checks for ended pixels

struct DrawArgs {
  BakedFrame frame;
  uint64_t atlas[kTileLevels];
  float near, offset, scale, alpha_offset, alpha_scale, weight_bound, transmittance_min;
  float sharp;  // of the low pass (core/resize.h)
  BakedImages images;
};

struct Pixel {
  float transmittance;  // negative once the pixel has ended
  float red, green, blue, beta, depth, nx, ny, nz;
  int count;
};

// A surfel's row in shared memory, read by all threads of a warp.
struct Row {
  float g[kGeom];
  float r2, blur2, red, green;
  const float4* rest;  // blue, texture
  uint32_t id;
};

// Fetches the texels of the pixels that need them, all before one is used. c, t: the row's `rest`.
template <bool kLevels>
__device__ __forceinline__ void fetch_texels(const DrawArgs& a, const float4& c, const float4& t,
                                             const bool (&wanted)[kPixels], const Fragment<FastFloat> (&f)[kPixels],
                                             float4 (&texel)[kPixels]) {
  const auto fetch = [&](uint64_t atlas) {
    BT_UNROLL
    for (int j = 0; j < kPixels; ++j)
      if (wanted[j])
        texel[j] = fetch_texel(atlas, t.x + texel_position_scaled(f[j].u, t.z, c.y).v,
                               t.y + texel_position_scaled(f[j].v, t.w, c.y).v);
  };
  // by name, not index: see AtlasTexture
  if (!kLevels || c.z == 0)
    fetch(a.atlas[0]);
  else if (c.z == 1)
    fetch(a.atlas[1]);
  else
    fetch(a.atlas[2]);
}

// Multiplies sigma by alpha where the weight reaches the bound (AlphaTiles), and keeps the texels: fragments whose
// weight later suffices for a residual are among them.
template <bool kLevels>
__device__ __forceinline__ void cut(const DrawArgs& a, const Row& s, const bool (&covers)[kPixels],
                                    const Pixel (&p)[kPixels], Fragment<FastFloat> (&f)[kPixels],
                                    float4 (&texel)[kPixels]) {
  const float4 c = s.rest[0];
  bool reaches[kPixels], any = false;
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) {
    const float sigma = f[j].sigma.v;
    any |= reaches[j] =
        covers[j] && sigma >= float(kAlphaMin) && bt::blend(sigma, p[j].transmittance).weight >= a.weight_bound;
  }
  if (!any || c.y == 0) return;
  const float4 t = s.rest[1];
  if (c.y > 0) fetch_texels<kLevels>(a, c, t, reaches, f, texel);
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j)
    if (reaches[j])
      f[j].sigma = FastFloat(alpha_cut(f[j].sigma.v, c.y > 0 ? a.alpha_offset + a.alpha_scale * texel[j].w : t.w));
}

// Adds a row's fragments to the thread's pixels, with weight 0 unless taken. texel: with kAlpha the result of `cut`.
template <bool kMaps, bool kLevels, bool kAlpha>
__device__ __forceinline__ void add(const DrawArgs& a, const Row& s, const bool (&taken)[kPixels],
                                    const float (&weight)[kPixels], const Fragment<FastFloat> (&f)[kPixels],
                                    float4 (&texel)[kPixels], Pixel (&p)[kPixels]) {
  const float4 c = s.rest[0];
  Vec3<FastFloat> color[kPixels];
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) color[j] = {FastFloat(s.red), FastFloat(s.green), FastFloat(c.x)};
  bool textured[kPixels], any = false;
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) any |= textured[j] = weight[j] >= a.weight_bound;
  if (any && c.y != 0) {
    const float4 t = s.rest[1];
    if (c.y > 0) {
      if (!kAlpha) fetch_texels<kLevels>(a, c, t, textured, f, texel);
      BT_UNROLL
      for (int j = 0; j < kPixels; ++j)
        if (textured[j])
          color[j] = {shaded(color[j].x + FastFloat(a.offset), FastFloat(a.scale * texel[j].x)),
                      shaded(color[j].y + FastFloat(a.offset), FastFloat(a.scale * texel[j].y)),
                      shaded(color[j].z + FastFloat(a.offset), FastFloat(a.scale * texel[j].z))};
    } else {
      BT_UNROLL
      for (int j = 0; j < kPixels; ++j)
        if (textured[j]) color[j] = {FastFloat(t.x), FastFloat(t.y), FastFloat(t.z)};
    }
  }
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) {
    const float w = weight[j];
    p[j].red += w * color[j].x.v, p[j].green += w * color[j].y.v, p[j].blue += w * color[j].z.v;
    if (kMaps && taken[j]) {
      p[j].beta += w * s.g[kBeta];
      const float4 n = a.frame.memory.normals ? a.frame.memory.normals[s.id] : make_float4(0, 0, 0, 0);
      p[j].depth += w * f[j].depth.v;
      p[j].nx += w * n.x, p[j].ny += w * n.y, p[j].nz += w * n.z;
      ++p[j].count;
    }
  }
}

// Evaluates and blends a row at the thread's pixels, the first at offset (dx, dy) from the projected centre, both at
// once for instruction-level parallelism. Without kAll, neither the low pass nor the near plane is tested: for rows
// that need no test.
template <bool kMaps, class Kernel, bool kAlpha, bool kAll>
__device__ __forceinline__ void blend(const DrawArgs& a, const Row& s, float dx, float dy, Pixel (&p)[kPixels]) {
  Planes<FastFloat> at[kPixels];
  FastFloat y[kPixels];
  bool taken[kPixels], any = false;
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) {
    y[j] = FastFloat(j ? dy + kBandRows * j : dy);
    taken[j] = p[j].transmittance > 0;
    at[j] = planes(s.g, FastFloat(dx), y[j]);  // they alone reject most pixels
    bool inside = within_in_front(at[j], FastFloat(s.r2));
    if (kAll) inside = (inside & behind_near(s.g, a.near, at[j].W)) | (dx * dx + y[j].v * y[j].v < s.blur2);
    taken[j] &= inside;
    any |= taken[j];
  }
  if (!any) return;
  Fragment<FastFloat> f[kPixels];
  float4 texel[kPixels];
  float weight[kPixels];
  any = false;
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) {
    if (kAll)
      f[j] = fragment<Kernel, true>(s.g, a.near, FastFloat(dx), y[j], a.sharp);
    else
      f[j] = fragment_within(s.g, at[j]);
  }
  if (kAlpha) cut<Kernel::kResized>(a, s, taken, p, f, texel);
  BT_UNROLL
  for (int j = 0; j < kPixels; ++j) {
    const float sigma = f[j].sigma.v;
    const Blend<float> b = bt::blend(sigma, p[j].transmittance);
    const BlendTest<float> v = blend_test(taken[j], sigma, b.behind, a.transmittance_min);
    const float left = v.takes ? b.behind : p[j].transmittance;
    p[j].transmittance = v.ends ? -left : left;
    weight[j] = v.takes ? b.weight : 0;
    taken[j] = v.takes;
    any |= taken[j];
  }
  if (any) add<kMaps, Kernel::kResized, kAlpha>(a, s, taken, weight, f, texel, p);
}

// Rounds like the float image's conversion; the product must not be fused.
__device__ uint32_t to_byte(float x) {
#if defined(__CUDA_ARCH__)
  return uint32_t(__fmul_rn(clamp_(x, 0.0f, 1.0f), 255.0f) + 0.5f);
#else
  return uint32_t(clamp_(x, 0.0f, 1.0f) * 255.0f + 0.5f);
#endif
}

template <bool kMaps> __device__ void write(const DrawArgs& a, const Pixel& p, int64_t at) {
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

// Tiles with long lists are drawn first, so that none is left at the end: blocks swap tiles with those of long lists.
__device__ unsigned tile_of_block(const BakedMemory& m, unsigned block) {
  if (block < unsigned(*m.long_count)) return m.long_tiles[block];
  unsigned tile = block;
  while (const uint32_t i = m.lists[tile].long_index) tile = i - 1;
  return tile;
}

// Blocks per multiprocessor: as many as the registers of the pair loop (without the sort) allow.
template <bool kMaps, class Kernel, bool kAlpha>
constexpr int kBlocks = bounded_blocks((kMaps ? 7 : (Kernel::kResized ? 8 : 9)) - int(kAlpha), kThreads);

template <bool kMaps, class Kernel, bool kAlpha>
__global__ void __launch_bounds__(kThreads, kBlocks<kMaps, Kernel, kAlpha>) draw_kernel(DrawArgs a) {
  __shared__ float4 staged[kWarps][kWarp * kRowQuads];
  __shared__ uint32_t queues[kWarps][2 * kWarp];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const BakedFrame& f = a.frame;
  const unsigned tile = f.rows ? tile_of_block(f.memory, blockIdx.x) : blockIdx.x;
  const unsigned tiles_of_view = unsigned(f.tiles_x * f.tiles_y);
  const int in_view = int(tile % tiles_of_view);
  const int x = in_view % f.tiles_x * kTile + (warp & 1) * 8 + (lane & 7);
  const int y = in_view / f.tiles_x * kTile + (warp >> 1) * (kBandRows * kPixels) + (lane >> 3);
  const float px = pixel_centre<float>(x), py = pixel_centre<float>(y);
  const int count = f.rows ? sort_list(f, tile, reinterpret_cast<Key*>(&staged[0][0])) : 0;
  float4* stage = staged[warp];
  uint32_t* queue = queues[warp];
  Pixel p[kPixels];
  uint32_t part[kPixels];  // bit of the part of the tile with the thread's pixel
  for (int j = 0; j < kPixels; ++j) {
    p[j] = {x < f.width && y + kBandRows * j < f.height ? 1.0f : -1.0f, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    part[j] = 1u << (2 * ((warp >> 1) * kPixels + j) + (warp & 1));
  }
  uint32_t wanted = 0;  // parts with pixels that are not ended
  for (int j = 0; j < kPixels; ++j) wanted |= __any_sync(kFullMask, p[j].transmittance > 0) ? part[j] : 0;

  int next = 0;
  int waiting = 0;  // in the queue
  while (wanted) {
    while (waiting < kWarp && next < count) {
      const uint32_t from = next < f.slots ? tile * unsigned(f.slots) : f.memory.lists[tile].rest;
      const uint32_t pair = next + lane < count ? f.memory.pairs[from + unsigned(next + lane)] : 0u;
      const unsigned votes = __ballot_sync(kFullMask, (pair & wanted) != 0);
      if (pair & wanted) queue[waiting + count_below(votes, lane)] = pair;
      waiting += __popc(votes);
      next += kWarp;
    }
    __syncwarp();
    const int in_hand = min_(waiting, kWarp);
    if (in_hand == 0) break;
    // three loads in flight: six would exceed the registers
    BT_UNROLL_BY(3)
    for (int k = 0; k < kRowQuads; ++k) {
      const int quad = k * kWarp + lane, r = quad / kRowQuads;
      if (r < in_hand)
        stage[quad] = __ldg(reinterpret_cast<const float4*>(f.memory.rows) + int64_t(queue[r] >> 8) * kRowQuads +
                            quad % kRowQuads);
    }
    __syncwarp();
    const float4* q = stage;
    for (int begin = 0; begin < in_hand; begin += kCheckEvery) {
      bool open = false;
      for (int j = 0; j < kPixels; ++j) open |= p[j].transmittance > 0;
      if (!__any_sync(kFullMask, open)) break;
      for (int k = begin; k < min_(begin + kCheckEvery, in_hand); ++k, q += kRowQuads) {
        const float4 q0 = q[0], q1 = q[1], q2 = q[2], q3 = q[3];
        float height = 0;
        if (Kernel::kResized && q3.y > 0)
          height = exp_(FastFloat(q3.y * a.sharp)).v * float(kAlphaMin) / q2.z;  // q2.z: opacity
        const Row s = {{q0.x, q0.y, q0.z, q0.w, q1.x, q1.y, q1.z, q1.w, q2.x, q2.y, q2.z, q2.w, 0, 0, 0, height},
                       q3.x,
                       q3.y,
                       q3.z,
                       q3.w,
                       q + 4,
                       kMaps ? queue[k] >> 8 : 0};
        const float dx = px - s.g[kCx], dy = py - s.g[kCy];
        if (s.blur2 != 0)
          blend<kMaps, Kernel, kAlpha, true>(a, s, dx, dy, p);
        else
          blend<kMaps, Kernel, kAlpha, false>(a, s, dx, dy, p);
      }
    }
    wanted = 0;
    for (int j = 0; j < kPixels; ++j) wanted |= __any_sync(kFullMask, p[j].transmittance > 0) ? part[j] : 0;
    waiting -= in_hand;
    const uint32_t moved = lane < waiting ? queue[kWarp + lane] : 0;
    __syncwarp();
    if (lane < waiting) queue[lane] = moved;
  }
  const int64_t view = tile / tiles_of_view;
  for (int j = 0; j < kPixels; ++j) {
    const int column = int(px), row = int(py) + kBandRows * j;  // recomputed: keeping x and y costs registers
    if (column < f.width && row < f.height) write<kMaps>(a, p[j], (view * f.height + row) * f.width + column);
  }
}
}  // namespace

void baked_draw(const BakedScene& s, const BakedImages& images, const BakedFrame& f, Stream stream) {
  if (!f.tiles) return;
  static_assert(kTileLevels == 3);
  const auto handle = [&](int level) { return s.levels[level] ? s.levels[level]->handle() : 0; };
  const DrawArgs a = {f,
                      {handle(0), handle(1), handle(2)},
                      s.near,
                      s.offset,
                      s.scale,
                      s.alpha_scale != 0 ? 0.0f : 1.0f,  // opaque texels have m = 1
                      s.alpha_scale,
                      max_(s.weight_bound, 1e-30f),  // above the weight of pixels without a fragment
                      s.transmittance_min,
                      Resize<float>(f.photo_pixel).sharp,
                      images};
  const dim3 grid(static_cast<unsigned>(f.tiles));
  const bool maps = images.beta || images.depth || images.normal || images.overdraw;
  const bool alpha = s.alpha_scale != 0 || s.mean_alpha;
  with_kernel(f.photo_pixel, [&](auto kernel) {
    using Kernel = decltype(kernel);
    const auto draw = alpha ? (maps ? draw_kernel<true, Kernel, true> : draw_kernel<false, Kernel, true>)
                            : (maps ? draw_kernel<true, Kernel, false> : draw_kernel<false, Kernel, false>);
    BT_LAUNCH(draw, grid, dim3(kThreads), 0, stream, a);
  });
}

}  // namespace bt::cuda
