// The baked renderer: forward only, no fragment list, texels instead of the field.
#include <stdexcept>
#include <string>

#include "core/shading.h"
#include "core/texel.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"
#include "cpu/tiles.h"

namespace bt {

namespace {
// Red, green and blue of a texel for each lane.
template <class S>
struct Texels {
  Pack<S> rgb[3];
};
// The texels at the lanes' places in a tile's texels, and their right neighbours.
template <class S>
struct TexelPairs {
  Texels<S> left, right;
};

template <class S>
inline Texels<S> texels_of(const Wide<uint32_t>& rgba) {
  Texels<S> t;
  for (int c = 0; c < 3; ++c) t.rgb[c] = from_integers<S>(rgba >> 8 * c & 255u);
  return t;
}
#if defined(__AVX2__)
// Of eight lanes, those at `at`: from 8 bytes for each, which hold both.
inline void eight_pairs(const uint8_t* patch, const int32_t* at, __m256i* left, __m256i* right) {
  const auto two = [&](int i) {
    const __m128i first = _mm_loadl_epi64((const __m128i*)(patch + 4 * int64_t(at[i])));
    int64_t second;
    std::memcpy(&second, patch + 4 * int64_t(at[i + 1]), sizeof second);
    return _mm_insert_epi64(first, second, 1);
  };
  const __m256 a = (__m256)_mm256_set_m128i(two(4), two(0)), b = (__m256)_mm256_set_m128i(two(6), two(2));
  *left = (__m256i)_mm256_shuffle_ps(a, b, 0x88), *right = (__m256i)_mm256_shuffle_ps(a, b, 0xdd);
}
#endif
template <class S>
inline TexelPairs<S> texel_pairs(const uint8_t* patch, const int32_t* at) {
#if defined(__AVX2__)
  __m256i l[2], r[2];
  eight_pairs(patch, at, l, r), eight_pairs(patch, at + 8, l + 1, r + 1);
  const Wide<uint32_t> left = joined(l[0], l[1]), right = joined(r[0], r[1]);
#else
  Wide<uint32_t> left, right;
  uint32_t pair[2];
  for (int i = 0; i < kLanes; ++i) {
    std::memcpy(pair, patch + 4 * int64_t(at[i]), sizeof pair);
    set_lane(left, i, pair[0]), set_lane(right, i, pair[1]);
  }
#endif
  return {texels_of<S>(left), texels_of<S>(right)};
}
template <class S>
inline TexelPairs<S> texel_pairs(const float* patch, const int32_t* at) {
  TexelPairs<S> t;
  for (int i = 0; i < kLanes; ++i)
    for (int c = 0; c < 3; ++c) {
      const float* p = patch + 4 * int64_t(at[i]) + c;
      t.left.rgb[c].set(i, S(p[0])), t.right.rgb[c].set(i, S(p[4]));
    }
  return t;
}

// Residuals at the lanes' positions in a tile, bilinear. A position is clamped to the outer texel centres, so at a
// tile's last column and row the neighbour has weight 0 and may be any texel.
template <class S, class T>
inline Texels<S> bilinear(const T* patch, int columns, Pack<S> x, Pack<S> y) {
  using P = Pack<S>;
  const P x0 = floor_(x), y0 = floor_(y), fx = x - x0, fy = y - y0;
  int32_t at[kLanes];
  store_integers(at, y0 * P(S(columns)) + x0);  // exact: a tile has fewer than 2^24 texels
  const TexelPairs<S> top = texel_pairs<S>(patch, at), bottom = texel_pairs<S>(patch + 4 * columns, at);
  Texels<S> t;
  for (int c = 0; c < 3; ++c) {
    const P left = top.left.rgb[c] + fy * (bottom.left.rgb[c] - top.left.rgb[c]);
    const P right = top.right.rgb[c] + fy * (bottom.right.rgb[c] - top.right.rgb[c]);
    t.rgb[c] = left + fx * (right - left);
  }
  return t;
}
}  // namespace

void gather_patches(int layers, int height, int width, const uint8_t* bytes, const float* floats, int64_t n,
                    const int32_t* tiles, Patches& out) {
  out.first.resize(n), out.sides.resize(2 * n);
  int64_t texels = 0;
  int widest = 0;
  for (int64_t i = 0; i < n; ++i) {
    const int32_t* t = tiles + 5 * i;
    const bool none = (!bytes && !floats) || t[3] == 0;
    const int columns = none ? 0 : t[3], rows = none ? 0 : t[4];
    if (!none && (t[0] < 0 || t[1] < 0 || t[2] < 0 || t[2] >= layers || columns < 1 || rows < 1 ||
                  int64_t(t[0]) + columns > width || int64_t(t[1]) + rows > height))
      throw std::invalid_argument("the tile of surfel " + std::to_string(i) + " does not lie on a page of the atlas");
    out.first[i] = texels, out.sides[2 * i] = columns, out.sides[2 * i + 1] = rows;
    texels += int64_t(columns) * rows;
    widest = std::max(widest, columns);
  }
  const int64_t size = 4 * (texels + widest + 2);  // a fetch at the last texel reads its neighbours, with weight 0
  out.bytes.assign(bytes ? size : 0, 0), out.floats.assign(floats ? size : 0, 0.0f);
  parallel_parts(n, 64, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int32_t* t = tiles + 5 * i;
      const int64_t line = 4 * int64_t(out.sides[2 * i]);
      for (int row = 0; row < out.sides[2 * i + 1]; ++row) {
        const int64_t from = 4 * ((int64_t(t[2]) * height + t[1] + row) * width + t[0]);
        const int64_t to = 4 * out.first[i] + row * line;
        if (bytes) std::copy_n(bytes + from, line, out.bytes.data() + to);
        if (floats) std::copy_n(floats + from, line, out.floats.data() + to);
      }
    }
  });
}

namespace {
// The level of a surfel's tile that a view shows; null: its mean alone.
template <class S>
const Patches* level_of(const BakedForward<S>& a, int64_t id, S extent) {
  const int32_t* sides = a.patches->sides.data() + 2 * id;
  int level = tile_level(a.view.geom + id * kGeom, sides[0], sides[1], extent, a.view.photo_pixel);
  if (level == kTileLevels) return a.residual.mean_residual ? nullptr : a.patches;
  while (level && !(a.coarser[level - 1] && a.coarser[level - 1]->sides[2 * id])) --level;
  return level ? a.coarser[level - 1] : a.patches;
}

// Residuals of a surfel's level at surfel coordinates.
template <class S>
inline Texels<S> fetch(const Patches& level, int64_t id, S extent, Pack<S> u, Pack<S> v, const BakedResidual& atlas) {
  const int32_t* sides = level.sides.data() + 2 * id;
  const Pack<S> x = texel_position(u, sides[0], extent), y = texel_position(v, sides[1], extent);
  const int64_t first = 4 * level.first[id];
  Texels<S> t = level.floats.empty() ? bilinear<S>(level.bytes.data() + first, sides[0], x, y)
                                     : bilinear<S>(level.floats.data() + first, sides[0], x, y);
  for (auto& channel : t.rgb) channel = Pack<S>(S(atlas.offset)) + Pack<S>(S(atlas.scale)) * channel;
  return t;
}

// Asks for what a surfel that comes soon is drawn from: a tile's list names surfels from all over the memory.
constexpr int kAhead = 3;
template <class S>
void prefetch(const BakedForward<S>& a, int64_t id) {
  __builtin_prefetch(a.view.geom + id * kGeom);
  __builtin_prefetch(a.view.radii + 2 * id);
  __builtin_prefetch(a.base + 3 * id);
  __builtin_prefetch(a.patches->sides.data() + 2 * id);
  __builtin_prefetch(a.patches->first.data() + id);
}
// And later for its first texels.
template <class S>
void prefetch_texels(const BakedForward<S>& a, int64_t id) {
  if (a.patches->bytes.empty()) return;
  const uint8_t* p = a.patches->bytes.data() + 4 * a.patches->first[id];
  for (int line = 0; line < 4; ++line) __builtin_prefetch(p + 64 * line);
}

template <class Kernel, class S>
void baked_forward(const BakedForward<S>& a) {
  using P = Pack<S>;
  const S *geom = a.view.geom, *radii = a.view.radii, *base = a.base, near = a.view.near;
  const int width = a.view.width, height = a.view.height;
  const bool maps = a.maps;
  const Bins& bins = *a.bins;
  const BakedResidual& atlas = a.residual;
  S* image = a.image;
  int32_t* overdraw = a.overdraw;
  constexpr float kNone[3] = {0, 0, 0};
  const int64_t tiles = int64_t(bins.tiles_x) * bins.tiles_y;
  const int channels = maps ? kMapChannels : kBakedChannels;
  const S photo_pixel = a.view.photo_pixel, sharp = Resize<S>(photo_pixel).sharp;
#pragma omp parallel for num_threads(num_threads()) schedule(dynamic, 2)
  for (int64_t tile = 0; tile < tiles; ++tile) {
    const int tx = int(tile % bins.tiles_x), ty = int(tile / bins.tiles_x);
    TileState<S> state(tx, ty, width, height, S(atlas.transmittance_min));
    P sums[kMapChannels + 1][kPacks];  // rgb, alpha, beta, depth, normal, overdraw
    for (auto& row : sums) std::fill(row, row + kPacks, P(S(0)));
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_packs; ++k) {
      const int64_t id = bins.surfels[k];
      if (k + kAhead < bins.start[tile + 1]) prefetch(a, bins.surfels[k + kAhead]);
      if (k + 1 < bins.start[tile + 1]) prefetch_texels(a, bins.surfels[k + 1]);
      const S* g = geom + id * kGeom;
      const S extent = atlas.extent ? S(atlas.extent[id]) : S(kSupport);
      bool tiled = a.patches->sides[2 * id] != 0;
      // found when a fragment asks for texels, which those below the weight bound do not
      const Patches* level = a.coarser[0] ? nullptr : a.patches;
      const float* flat = atlas.mean_residual ? atlas.mean_residual + 3 * id : kNone;
      const bool plain_only = !tiled && flat[0] == 0 && flat[1] == 0 && flat[2] == 0;
      const S bound = plain_only ? S(2) : S(atlas.weight_bound);  // no weight reaches 2
      S view[3];
      store3(view, view_base(load3(base + 3 * id)));
      state.template blend<Kernel>(
          g, radii + 2 * id, near,
          [&](int pack, const typename P::M& taken, const Fragment<P>& f, P weight) {
            const typename P::M textures = taken & (weight >= P(bound));
            const P w = select(taken, weight, P(S(0)));
            P colour[3] = {P(view[0]), P(view[1]), P(view[2])};
            if (bits(textures)) {
              if (tiled && !level) level = level_of(a, id, extent), tiled = level != nullptr;
              const Texels<S> residual = tiled ? fetch<S>(*level, id, extent, f.u, f.v, atlas)
                                               : Texels<S>{P(S(flat[0])), P(S(flat[1])), P(S(flat[2]))};
              for (int c = 0; c < 3; ++c) colour[c] = select(textures, shaded(colour[c], residual.rgb[c]), colour[c]);
            }
            for (int c = 0; c < 3; ++c) sums[c][pack] += w * colour[c];
            sums[3][pack] += w;
            if (maps) {
              sums[4][pack] += w * P(g[kBeta]);
              sums[5][pack] += select(taken, w * f.depth, P(S(0)));
              for (int c = 0; c < 3; ++c) sums[6 + c][pack] += w * P(g[kNx + c]);
            }
            if (overdraw) sums[kMapChannels][pack] += select(taken, P(S(1)), P(S(0)));
          },
          sharp);
    }
    for (int pack = 0; pack < kPacks; ++pack)
      for (int lane = 0; lane < kLanes; ++lane) {
        const int x = tx * kTile + pack_column(pack) + lane % kPackSide;
        const int y = ty * kTile + pack_row(pack) + lane / kPackSide;
        if (x >= width || y >= height) continue;
        const int64_t pixel = int64_t(y) * width + x;
        S* to = image + pixel * channels;
        for (int c = 0; c < channels; ++c) to[c] = sums[c][pack][lane];
        if (overdraw) overdraw[pixel] = int32_t(sums[kMapChannels][pack][lane]);
      }
  }
}
}  // namespace

template <class S>
void baked_forward(const BakedForward<S>& a) {
  bin(a.view, *a.bins);
  with_kernel(a.view.through_pixel, float(a.view.photo_pixel),
              [&](auto kernel) { baked_forward<decltype(kernel)>(a); });
}

template void baked_forward(const BakedForward<float>&);
template void baked_forward(const BakedForward<double>&);

}  // namespace bt
