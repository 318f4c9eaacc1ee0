// The baked renderer: forward only, no fragment list, texels instead of the field.
#include "core/texel.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"
#include "cpu/tiles.h"

namespace bt {

namespace {
template <class S>
inline Quad<S> texel(const Atlas& a, int64_t at) {
  if (a.bytes) {
    typedef uint8_t B __attribute__((vector_size(4)));
    B b;
    std::memcpy(&b, a.bytes + 4 * at, 4);
    return __builtin_convertvector(b, Quad<S>);
  }
  Quad<float> t;
  std::memcpy(&t, a.floats + 4 * at, sizeof t);
  return __builtin_convertvector(t, Quad<S>);
}
// Residual colour at position (x, y) of a tile, bilinear; `at` is the texel at the whole numbers below.
template <class S>
inline Quad<S> residual(const Atlas& a, const int32_t* tile, int64_t at, S x, S y) {
  const int x0 = int(x), y0 = int(y);
  const int64_t right = x0 + 1 < tile[3] ? 1 : 0, down = y0 + 1 < tile[4] ? a.width : 0;
  const S fx = x - S(x0), fy = y - S(y0);
  const Quad<S> t00 = texel<S>(a, at), t10 = texel<S>(a, at + right);
  const Quad<S> t01 = texel<S>(a, at + down), t11 = texel<S>(a, at + down + right);
  const Quad<S> upper = t00 + fx * (t10 - t00), lower = t01 + fx * (t11 - t01);
  return (upper + fy * (lower - upper)) * S(a.scale) + S(a.offset);
}
inline void prefetch(const Atlas& a, int64_t at) {
  if (a.bytes)
    __builtin_prefetch(a.bytes + 4 * at), __builtin_prefetch(a.bytes + 4 * (at + a.width));
  else
    __builtin_prefetch(a.floats + 4 * at), __builtin_prefetch(a.floats + 4 * (at + a.width));
}
}  // namespace

template <class S>
void baked_forward(const S* geom, const S* radii, S near, const Bins& bins, int width, int height, bool maps,
                   const S* base, const Atlas& atlas, S* image, int32_t* overdraw) {
  using P = Pack<S>;
  const int64_t tiles = int64_t(bins.tiles_x) * bins.tiles_y;
  const int channels = maps ? kMapChannels : kImageChannels;
  const bool textured = atlas.bytes || atlas.floats;
#pragma omp parallel for num_threads(num_threads()) schedule(dynamic, 2)
  for (int64_t tile = 0; tile < tiles; ++tile) {
    const int tx = int(tile % bins.tiles_x), ty = int(tile / bins.tiles_x);
    TileState<S> state(tx, ty, width, height);
    // fragments with a residual sum into rgb, one by one; all the rest in packs
    Quad<S> rgb[kTile * kTile] = {};
    P sums[4 + kMapChannels][kPacks];  // rgb of the fragments without residual, alpha, beta, depth, normal, overdraw
    for (auto& row : sums) std::fill(row, row + kPacks, P(S(0)));
    const int drawn = channels;
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_packs; ++k) {
      const int64_t id = bins.surfels[k];
      const S* g = geom + id * kGeom;
      const int32_t* patch = atlas.tiles + 5 * id;
      const bool tiled = textured && patch[3] != 0;
      const float* flat = atlas.mean_residual + 3 * id;
      const bool plain_only = !tiled && flat[0] == 0 && flat[1] == 0 && flat[2] == 0;
      const S bound = plain_only ? S(2) : S(atlas.weight_bound);  // no weight reaches 2
      const S extent = S(atlas.extent[id]);
      const S view[3] = {relu(base[3 * id] + S(0.5)), relu(base[3 * id + 1] + S(0.5)), relu(base[3 * id + 2] + S(0.5))};
      state.blend(g, radii + 2 * id, near, [&](int pack, uint32_t lanes, const Fragment<P>& f, P weight) {
        const typename P::M taken = mask_of<S>(lanes), textures = taken & (weight >= P(bound));
        const P w = select(taken, weight, P(S(0))), plain = select(textures, P(S(0)), w);
        for (int c = 0; c < 3; ++c) sums[c][pack] += plain * P(view[c]);
        sums[3][pack] += w;
        sums[4][pack] += w * P(g[kBeta]);
        if (maps) {
          sums[5][pack] += w * f.depth;
          for (int c = 0; c < 3; ++c) sums[6 + c][pack] += w * P(g[kNx + c]);
        }
        if (overdraw) sums[drawn][pack] += select(taken, P(S(1)), P(S(0)));
        const uint32_t rest = bits(textures);
        if (!rest) return;
        if (!tiled) {
          for (int c = 0; c < 3; ++c) sums[c][pack] += (w - plain) * P(relu(view[c] + S(flat[c])));
          return;
        }
        S x[kLanes], y[kLanes], wt[kLanes];
        store(x, texel_position(f.u, patch[3], extent));
        store(y, texel_position(f.v, patch[4], extent));
        store(wt, weight);
        const Quad<S> colour = {view[0], view[1], view[2], S(0)};
        Quad<S>* to = rgb + pack * kLanes;
        int64_t at[kLanes];
        const int64_t corner = (int64_t(patch[2]) * atlas.height + patch[1]) * atlas.width + patch[0];
        for (uint32_t r = rest; r; r &= r - 1) {
          const int i = __builtin_ctz(r);
          at[i] = corner + int64_t(int(y[i])) * atlas.width + int(x[i]);
          prefetch(atlas, at[i]);
        }
        for (uint32_t r = rest; r; r &= r - 1) {
          const int i = __builtin_ctz(r);
          const Quad<S> c = colour + residual(atlas, patch, at[i], x[i], y[i]);
          to[i] += wt[i] * (c < S(0) ? Quad<S>{} : c);
        }
      });
    }
    for (int pack = 0; pack < kPacks; ++pack)
      for (int lane = 0; lane < kLanes; ++lane) {
        const int x = tx * kTile + pack % kPacksAcross * kPackSide + lane % kPackSide;
        const int y = ty * kTile + pack / kPacksAcross * kPackSide + lane / kPackSide;
        if (x >= width || y >= height) continue;
        const int64_t pixel = int64_t(y) * width + x;
        S* to = image + pixel * channels;
        for (int c = 0; c < channels; ++c) to[c] = sums[c][pack][lane];
        for (int c = 0; c < 3; ++c) to[c] += rgb[pack * kLanes + lane][c];
        if (overdraw) overdraw[pixel] = int32_t(sums[drawn][pack][lane]);
      }
  }
}

template void baked_forward<float>(const float*, const float*, float, const Bins&, int, int, bool, const float*,
                                   const Atlas&, float*, int32_t*);
template void baked_forward<double>(const double*, const double*, double, const Bins&, int, int, bool, const double*,
                                    const Atlas&, double*, int32_t*);

}  // namespace bt
