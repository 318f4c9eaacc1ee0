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
// Two texels that lie next to each other, as eight reals.
template <class S>
inline Oct<S> texel_pair(const uint8_t* at) {
  typedef uint8_t B __attribute__((vector_size(8)));
  B b;
  std::memcpy(&b, at, sizeof b);
  return __builtin_convertvector(b, Oct<S>);
}
#if defined(__AVX2__)
template <>
inline Oct<float> texel_pair<float>(const uint8_t* at) {  // the compiler takes the bytes one by one
  return (Oct<float>)_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i*)at)));
}
#endif
template <class S>
inline Oct<S> texel_pair(const float* at) {
  Oct<float> b;
  std::memcpy(&b, at, sizeof b);
  return __builtin_convertvector(b, Oct<S>);
}

// The textured fragments of a pack: to[lane] += weight * relu(colour + scale * texel), bilinear. The position is
// clamped to the outer texel centres, so at a tile's last column and row the neighbour has weight 0 and may be any
// texel.
template <class S, class T>
inline void add_textured(const T* patch, int columns, uint32_t lanes, Pack<S> x, Pack<S> y, Pack<S> weight,
                         Quad<S> colour, S scale, Quad<S>* to) {
  using P = Pack<S>;
  const P x0 = floor_(x), y0 = floor_(y);
  S fx[kLanes], fy[kLanes], at[kLanes], w[kLanes];
  store(fx, x - x0), store(fy, y - y0), store(w, weight);
  store(at, y0 * P(S(columns)) + x0);  // exact: a tile has fewer than 2^24 texels
  const int stride = 4 * columns;
  for (uint32_t r = lanes; r; r &= r - 1) __builtin_prefetch(patch + 4 * int(at[__builtin_ctz(r)]));
  for (uint32_t r = lanes; r; r &= r - 1) {
    const int i = __builtin_ctz(r);
    const T* p = patch + 4 * int(at[i]);
    const Oct<S> top = texel_pair<S>(p), bottom = texel_pair<S>(p + stride);
    const Oct<S> column = top + fy[i] * (bottom - top);
    const Quad<S> left = half<0, Quad<S>>(column), right = half<1, Quad<S>>(column);
    const Quad<S> c = colour + scale * (left + fx[i] * (right - left));
    to[i] += w[i] * relu_quad<S>(c);
  }
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

// Asks for what a surfel that comes soon is drawn from: a tile's list names surfels from all over the memory.
constexpr int kAhead = 3;
template <class S>
void prefetch(const BakedForward<S>& a, int64_t id) {
  __builtin_prefetch(a.view.geom + id * kGeom);
  __builtin_prefetch(a.view.radii + 2 * id);
  __builtin_prefetch(a.base + 3 * id);
  __builtin_prefetch(a.patches->sides.data() + 2 * id);
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
    // fragments with a residual sum into rgb, one by one; all the rest in packs
    Quad<S> rgb[kTile * kTile] = {};
    P sums[kMapChannels + 1][kPacks];  // rgb of the fragments without residual, alpha, beta, depth, normal, overdraw
    for (auto& row : sums) std::fill(row, row + kPacks, P(S(0)));
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_packs; ++k) {
      const int64_t id = bins.surfels[k];
      if (k + kAhead < bins.start[tile + 1]) prefetch(a, bins.surfels[k + kAhead]);
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
          [&](int pack, uint32_t lanes, const Fragment<P>& f, P weight) {
            const typename P::M taken = mask_of<S>(lanes), textures = taken & (weight >= P(bound));
            const P w = select(taken, weight, P(S(0))), plain = select(textures, P(S(0)), w);
            for (int c = 0; c < 3; ++c) sums[c][pack] += plain * P(view[c]);
            sums[3][pack] += w;
            if (maps) {
              sums[4][pack] += w * P(g[kBeta]);
              sums[5][pack] += w * f.depth;
              for (int c = 0; c < 3; ++c) sums[6 + c][pack] += w * P(g[kNx + c]);
            }
            if (overdraw) sums[kMapChannels][pack] += select(taken, P(S(1)), P(S(0)));
            const uint32_t rest = bits(textures);
            if (!rest) return;
            if (tiled && !level) level = level_of(a, id, extent), tiled = level != nullptr;
            if (!tiled) {
              for (int c = 0; c < 3; ++c) sums[c][pack] += (w - plain) * P(shaded(view[c], S(flat[c])));
              return;
            }
            const Patches& patches = *level;
            const int32_t* sides = patches.sides.data() + 2 * id;
            const P x = texel_position(f.u, sides[0], extent), y = texel_position(f.v, sides[1], extent);
            const Quad<S> colour = {view[0] + S(atlas.offset), view[1] + S(atlas.offset), view[2] + S(atlas.offset),
                                    S(0)};
            const int64_t first = 4 * patches.first[id];
            Quad<S>* to = rgb + pack * kLanes;
            if (patches.floats.empty())
              add_textured(patches.bytes.data() + first, sides[0], rest, x, y, weight, colour, S(atlas.scale), to);
            else
              add_textured(patches.floats.data() + first, sides[0], rest, x, y, weight, colour, S(atlas.scale), to);
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
        for (int c = 0; c < 3; ++c) to[c] += rgb[pack * kLanes + lane][c];
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
