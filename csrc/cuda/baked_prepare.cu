// First stage of the baked renderer: the surfels that a view sees, each as the row that the later stages read.
//
// One thread per surfel, 44 bytes in and 100 out where it is visible. View colours (196 bytes of parameters per surfel
// with seven sites, 20 + 24 per term of lean ones) are computed for the visible ones alone, by threads that stand next
// to each other: a block packs them.
#include "core/shading.h"
#include "core/view_color.h"
#include "cuda/baked_stages.h"
#include "cuda/primitives.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 128;

// The presets' numbers of terms as constants, so that the loops unroll and nothing goes to local memory.
__device__ Vec3<float> view_color_of(const BakedScene& s, int64_t i, Vec3<float> d) {
  if (s.lean.base) return view_color(s.lean, i, d);
  const ViewColorArrays<const float>& p = s.colors;
  return for_view_color(p.kind, [&](auto kind) {
    using Kind = decltype(kind);
    constexpr int kPreset = Kind::kPresetTerms;
    return p.terms == kPreset ? view_color<Kind>(kPreset, p, i, d) : view_color<Kind>(p.terms, p, i, d);
  });
}

__device__ void write_texture(const BakedScene& s, int64_t i, Vec3<float> color, float photo_pixel, float* row) {
  const int32_t* tile = s.tiles + 5 * i;
  int level = 0;
  if (s.pages && tile[3] != 0 && photo_pixel < 1) {
    level = tile_level(row, tile[3], tile[4], s.extent ? s.extent[i] : float(kSupport), photo_pixel);
    if (level == kTileLevels && !s.mean_residual) level = 0;
    while (level && level < kTileLevels && !(s.coarser[level - 1] && has_level(tile, level))) --level;
  }
  float scale = 0, place[4] = {0, 0, 0, 0};
  uint64_t page = 0;
  if (s.pages && tile[3] != 0 && level < kTileLevels) {
    scale = 0.5f / (s.extent ? s.extent[i] : float(kSupport));
    page = (level ? s.coarser[level - 1] : s.pages)[tile[2]];
    place[0] = float(tile[0] >> level) + 0.5f, place[1] = float(tile[1] >> level) + 0.5f;
    place[2] = float((tile[3] >> level) - 1), place[3] = float((tile[4] >> level) - 1);
  } else if (s.mean_residual) {
    const Vec3<float> flat = load3(s.mean_residual + 3 * i);
    if (flat.x != 0 || flat.y != 0 || flat.z != 0) {
      scale = -1;
      store3(place, shaded(color, flat));
    }
  }
  row[kTexelScale] = scale;
  memcpy(row + kPage, &page, sizeof page);
  for (int k = 0; k < 4; ++k) row[kTileX + k] = place[k];
}

template <class Kernel>
__global__ void __launch_bounds__(kThreads) prepare_kernel(BakedScene s, BakedViews v, BakedFrame f) {
  __shared__ int seen_count;
  __shared__ int seen_list[kThreads];
  const int64_t block = int64_t(blockIdx.x) * kThreads, i = block + threadIdx.x;
  const int view = blockIdx.y;
  const int64_t first = f.n * view, at = first + i;  // rows of the view; of the surfel
  if (threadIdx.x == 0) seen_count = 0;
  __syncthreads();

  float row[kGeom];
  bool seen = false;
  float z = 0;
  if (i < f.n) {
    const Surfels<float>& in = s.geometry;
    float geom[kGeom], frame[kFrame];
    const Pinhole<float> camera = pinhole(v.viewmats + 16 * view, v.Ks + 9 * view);
    seen = project<Kernel>(camera, surfel_row(in, i), s.near, geom, frame);
    const Resize<float> to(f.photo_pixel);
    if constexpr (Kernel::kResized) seen = seen && resize(to, geom);
    if (seen) {
      LevelSet<float> level;
      if constexpr (Kernel::kResized)
        level = level_set(geom, s.near, to.sharp);
      else if (filtered<Kernel>(geom))
        level = {filtered_bounds(geom).visible, 0, -geom[kArea]};
      else
        level = level_set(geom, s.near);
      for (int k = 0; k <= kBeta; ++k) row[k] = geom[k];
      row[kR2] = level.r2, row[kBlur2] = level.blur2;
      const Footprint area = footprint<Kernel>(row, v.width, v.height);
      const Interval<float> x = columns_of(area);
      seen = level.visible && area.top <= area.bottom && (area.bounds.whole || (x.x1 >= 0 && x.x0 <= v.width));
      z = geom[kZ];
      // where the nearest point of the disc lies behind `near`, so do all pixels of it
      const PlaneBounds<float>& disc = area.bounds;
      const float nearest = z * (1 - sqrt_(disc.cu * disc.cu + disc.cv * disc.cv));
      if (!Kernel::kPixel && row[kBlur2] == 0 && (disc.whole || !(nearest > s.near * 1.0001f))) row[kBlur2] = kNearCuts;
    }
    if (seen) {
      float4* to = reinterpret_cast<float4*>(f.memory.rows + at * kRow);
      for (int k = 0; k < 3; ++k) to[k] = make_float4(row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]);
      f.memory.rows[at * kRow + kR2] = row[kR2], f.memory.rows[at * kRow + kBlur2] = row[kBlur2];
      if (f.memory.normals) f.memory.normals[at] = make_float4(geom[kNx], geom[kNy], geom[kNz], 0);
    }
  }
  if (i < f.n) f.memory.depth[at] = seen ? sort_key(z) : kNeverSeen;

  if (seen) seen_list[atomicAdd(&seen_count, 1)] = threadIdx.x;
  __syncthreads();
  if (int(threadIdx.x) >= seen_count) return;
  const int64_t j = block + seen_list[threadIdx.x];
  double center[3];
  camera_center(v.viewmats + 16 * view, center);
  const Vec3<float> d = view_direction(s.geometry.means + 3 * j, center).n;
  const Vec3<float> color = view_base(view_color_of(s, j, d));
  float* to = f.memory.rows + (first + j) * kRow;
  store3(to + kRed, color);
  write_texture(s, j, color, f.photo_pixel, to);
}
}  // namespace

void baked_prepare(const BakedScene& s, const BakedViews& v, const BakedFrame& f, Stream stream) {
  if (!f.rows) return;
  const dim3 grid(unsigned(ceil_div(f.n, kThreads)), unsigned(v.count));
  with_kernel(f.through_pixel, f.photo_pixel, [&](auto kernel) {
    BT_LAUNCH(prepare_kernel<decltype(kernel)>, grid, dim3(kThreads), 0, stream, s, v, f);
  });
}

}  // namespace bt::cuda
