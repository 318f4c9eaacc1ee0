// First stage of the baked renderer: the visible surfels, as rows for drawing, and their screen tiles.
//
// One thread per surfel, 44 bytes in and, if visible, 100 out. A block then lists the pairs of its surfels from their
// footprints in shared memory. View colours (196 bytes of parameters per surfel with seven sites, 20 + 24 per term of
// lean ones) are computed for visible surfels only, by adjacent threads: a block compacts them.
#include "core/shading.h"
#include "core/view_color.h"
#include "cuda/baked_pairs.h"
#include "cuda/sort_scan.h"

namespace bt::cuda {

namespace {
constexpr int64_t kMostBlocks = 1024;  // a block takes fewer surfels while there are at most this many blocks,
constexpr int kLeastOwned = 4;         // but at least this many surfels
constexpr int kLargeParts = 16;        // shares of the tile rows of a surfel with many tiles
constexpr int kLargeBlocks = 528;      // four per multiprocessor of a large GPU

// The presets' numbers of terms are constants, so that loops unroll and local memory is not used.
__device__ Vec3<float> view_color_of(const BakedScene& s, int64_t i, Vec3<float> d) {
  if (s.colors.lean.base) return view_color(s.colors.lean, i, d);
  const ViewColorArrays<const float>& p = s.colors.whole;
  return for_view_color(p.kind, [&](auto kind) {
    using Kind = decltype(kind);
    constexpr int kPreset = Kind::kPresetTerms;
    return p.terms == kPreset ? view_color<Kind>(kPreset, p, i, d) : view_color<Kind>(p.terms, p, i, d);
  });
}

__device__ void write_texture(const BakedScene& s, int64_t i, Vec3<float> color, float photo_pixel, float* row) {
  const int32_t* tile = s.tiles + 5 * i;
  int level = 0;
  if (s.levels[0] && tile[3] != 0 && photo_pixel < 1) {
    level = tile_level(row, tile[3], tile[4], s.extent ? s.extent[i] : float(kSupport), photo_pixel);
    if (level == kTileLevels && !s.mean_residual) level = 0;
    while (level && level < kTileLevels && !(s.levels[level] && has_level(tile, level))) --level;
  }
  float scale = 0, texture[4] = {0, 0, 0, 0};
  if (s.levels[0] && tile[3] != 0 && level < kTileLevels) {
    scale = 0.5f / (s.extent ? s.extent[i] : float(kSupport));
    const int x = tile[0] + tile[2] / s.pages_down * s.page_width, y = tile[1] + tile[2] % s.pages_down * s.page_height;
    texture[0] = float(x >> level) + 0.5f, texture[1] = float(y >> level) + 0.5f;
    texture[2] = float((tile[3] >> level) - 1), texture[3] = float((tile[4] >> level) - 1);
  } else if (s.mean_residual || s.mean_alpha) {
    const Vec3<float> flat = s.mean_residual ? load3(s.mean_residual + 3 * i) : Vec3<float>{0, 0, 0};
    const float alpha = s.mean_alpha ? s.mean_alpha[i] : 1.0f;
    if (flat.x != 0 || flat.y != 0 || flat.z != 0 || alpha != 1) {
      scale = -1;
      store3(texture, shaded(color, flat));
      texture[3] = alpha;
    }
  }
  row[kTexelScale] = scale;
  row[kLevel] = float(level), row[kLevel + 1] = 0;
  for (int k = 0; k < 4; ++k) row[kTileX + k] = texture[k];
}

// A block takes `owned` surfels. Those with many tiles or without a box are deferred, as the block with most of them
// would dominate frame time.
template <class Kernel>
__global__ void __launch_bounds__(kListThreads, bounded_blocks(9, kListThreads))
    list_kernel(BakedScene s, BakedViews v, BakedFrame f, int owned) {
  __shared__ int seen_count;
  __shared__ int seen_list[kListThreads];
  __shared__ FootprintRoom area[kListThreads];
  const int64_t block = int64_t(blockIdx.x) * owned, i = block + threadIdx.x;
  const int view = blockIdx.y;
  const bool owns = int(threadIdx.x) < owned && i < f.n;
  const int64_t first = f.n * view, at = first + i;  // row of the view's first surfel; of this one
  if (threadIdx.x == 0) seen_count = 0;
  __syncthreads();

  float row[kGeom];
  bool seen = false;
  int rows = 0;  // rows of tiles
  float z = 0;
  if (owns) {
    const Surfels<float>& in = s.geometry;
    float geom[kGeom], frame[kFrame];
    const Pinhole<float> camera = pinhole(v.viewmats + 16 * view, v.Ks + 9 * view);
    seen = project(camera, surfel_row(in, i), s.near, geom, frame);
    const Resize<float> to(f.photo_pixel);
    if constexpr (Kernel::kResized) seen = seen && resize(to, geom);
    if (seen) {
      seen = level_row<Kernel>(geom, s.near, to.sharp, row);
      const Footprint<float> of = footprint(row, v.width, v.height);
      const Interval<float> x = columns_of(of);
      seen = seen && of.top <= of.bottom && (of.bounds.whole || (x.x1 >= 0 && x.x0 <= v.width));
      z = geom[kZ];
      if (seen && (of.bounds.whole || most_tiles(of, f) >= kLarge))
        f.memory.large[atomicAdd(f.memory.large_count, 1)] = uint32_t(at);
      else if (seen)
        footprint_in(area[threadIdx.x]) = of, rows = of.bottom - of.top + 1;
      // if the nearest point of the disc lies beyond `near`, all of it does
      const PlaneBounds<float>& disc = of.bounds;
      const float nearest = z * (1 - sqrt_(disc.cu * disc.cu + disc.cv * disc.cv));
      if (row[kBlur2] == 0 && (disc.whole || !(nearest > s.near * 1.0001f))) row[kBlur2] = kNearCuts;
    }
    if (seen) {
      float4* to = reinterpret_cast<float4*>(f.memory.rows + at * kRow);
      for (int k = 0; k < 3; ++k) to[k] = make_float4(row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]);
      f.memory.rows[at * kRow + kR2] = row[kR2], f.memory.rows[at * kRow + kBlur2] = row[kBlur2];
      if (f.memory.normals) f.memory.normals[at] = make_float4(geom[kNx], geom[kNy], geom[kNz], 0);
    }
  }
  if (owns) f.memory.depth[at] = seen ? sort_key(z) : kNeverSeen;

  if (seen) seen_list[atomicAdd(&seen_count, 1)] = threadIdx.x;
  __syncthreads();
  if (int(threadIdx.x) < seen_count) {
    const int64_t j = block + seen_list[threadIdx.x];
    double center[3];
    camera_center(v.viewmats + 16 * view, center);
    const Vec3<float> d = view_direction(s.geometry.means + 3 * j, center).n;
    const Vec3<float> color = view_base(view_color_of(s, j, d));
    float* to = f.memory.rows + (first + j) * kRow;
    store3(to + kRed, color);
    write_texture(s, j, color, f.photo_pixel, to);
  }
  list_pairs(f, area, owned, first + block, rows);
}

// Lists a row of tiles of a surfel without a box, one tile per lane. Returns their number.
__device__ int list_reached(const BakedFrame& f, uint32_t r, int ty, int lane) {
  const float* row = f.memory.rows + int64_t(r) * kRow;
  const uint32_t tile = first_tile(f, r, ty);
  int listed = 0;
  for (int first = 0; first < f.tiles_x; first += kWarp) {
    const int tx = first + lane;
    const uint32_t parts = tx < f.tiles_x ? reached_parts(row, tx, ty) : 0;
    listed += __popc(__ballot_sync(kFullMask, parts != 0));
    if (parts) list_pair(f, r, tile + uint32_t(tx), parts);
  }
  return listed;
}

// Lists the deferred surfels, a warp per share of the tile rows of one.
__global__ void __launch_bounds__(kListThreads, 4) large_pairs_kernel(BakedFrame f) {
  const BakedMemory& m = f.memory;
  const int lane = threadIdx.x % kWarp, warps = int(gridDim.x) * kListWarps;
  const int64_t shares = int64_t(*m.large_count) * kLargeParts;
  int64_t listed = 0;
  for (int64_t i = int64_t(blockIdx.x) * kListWarps + threadIdx.x / kWarp; i < shares; i += warps) {
    const uint32_t r = m.large[i / kLargeParts];
    const Footprint<float> of = footprint(m.rows + int64_t(r) * kRow, f.width, f.height);
    for (int ty = of.top + int(i % kLargeParts); ty <= of.bottom; ty += kLargeParts) {
      if (of.bounds.whole) {
        listed += list_reached(f, r, ty, lane);
        continue;
      }
      const TileRow row = tile_row(of, ty, f.width);
      const int width = row.right - row.left + 1;
      const uint32_t tile = first_tile(f, r, ty);
      for (int k = lane; k < width; k += kWarp)
        list_pair(f, r, tile + uint32_t(row.left + k), part_mask(row, row.left + k));
      listed += max_(width, 0);
    }
  }
  if (lane == 0 && listed) add_to(m.total, listed);
}

}  // namespace

void baked_list(const BakedScene& s, const BakedViews& v, const BakedFrame& f, Stream stream) {
  fill_zero(reinterpret_cast<char*>(f.memory.total), f.memory.cleared, stream);
  int owned = kListThreads;
  while (owned > kLeastOwned && ceil_div(f.rows, owned / 2) <= kMostBlocks) owned /= 2;
  const dim3 blocks(unsigned(ceil_div(f.n, owned)), unsigned(v.count));
  with_kernel(f.photo_pixel, [&](auto kernel) {
    BT_LAUNCH(list_kernel<decltype(kernel)>, blocks, dim3(kListThreads), 0, stream, s, v, f, owned);
  });
  const dim3 large(unsigned(min_<int64_t>(kLargeBlocks, ceil_div(f.rows * kLargeParts, kListWarps))));
  BT_LAUNCH(large_pairs_kernel, large, dim3(kListThreads), 0, stream, f);
}

}  // namespace bt::cuda
