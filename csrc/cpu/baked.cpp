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
// Residual colour at (u, v) of a tile, bilinear.
template <class S>
inline Quad<S> residual(const Atlas& a, const int32_t* tile, S u, S v) {
  const TexelPair<S> x = texel_pair(u, tile[3], S(a.extent)), y = texel_pair(v, tile[4], S(a.extent));
  const int64_t row0 = (int64_t(tile[2]) * a.height + tile[1] + y.i0) * a.width + tile[0];
  const int64_t row1 = row0 + int64_t(y.i1 - y.i0) * a.width;
  const Quad<S> top = texel<S>(a, row0 + x.i0), right = texel<S>(a, row0 + x.i1);
  const Quad<S> low = texel<S>(a, row1 + x.i0), corner = texel<S>(a, row1 + x.i1);
  const Quad<S> upper = top + x.fraction * (right - top), lower = low + x.fraction * (corner - low);
  const S scale = S(a.scale), offset = S(a.offset);
  return (upper + y.fraction * (lower - upper)) * scale + offset;
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
    Quad<S> rgba[kTile * kTile] = {};
    P extra[5][kPacks];  // beta, depth, normal
    for (auto& row : extra) std::fill(row, row + kPacks, P(S(0)));
    int32_t drawn[kTile * kTile] = {};
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_packs; ++k) {
      const int64_t id = bins.surfels[k];
      const S* g = geom + id * kGeom;
      const int32_t* patch = atlas.tiles + 5 * id;
      const bool flat = !textured || patch[3] == 0;
      const Quad<S> view = {relu(base[3 * id] + S(0.5)), relu(base[3 * id + 1] + S(0.5)),
                            relu(base[3 * id + 2] + S(0.5)), S(0)};
      state.blend(g, radii + 2 * id, near, [&](int pack, uint32_t lanes, const Fragment<P>& f, P weight) {
        S u[kLanes], v[kLanes], w[kLanes], kept[kLanes] = {};
        store(u, f.u), store(v, f.v), store(w, weight);
        Quad<S>* to = rgba + pack * kLanes;
        for (uint32_t rest = lanes; rest; rest &= rest - 1) {
          const int i = __builtin_ctz(rest);
          Quad<S> c = view;
          if (!flat && w[i] >= S(atlas.weight_bound)) {
            c += residual(atlas, patch, u[i], v[i]);
            c = c < S(0) ? Quad<S>{} : c;
          }
          c[3] = S(1);
          to[i] += w[i] * c;
          ++drawn[pack * kLanes + i];
          kept[i] = w[i];
        }
        const P wk = load(kept);
        extra[0][pack] += wk * P(g[kBeta]);
        if (maps) {
          extra[1][pack] += wk * f.depth;
          for (int c = 0; c < 3; ++c) extra[2 + c][pack] += wk * P(g[kNx + c]);
        }
      });
    }
    for (int pack = 0; pack < kPacks; ++pack)
      for (int lane = 0; lane < kLanes; ++lane) {
        const int x = tx * kTile + pack % kPacksAcross * kPackSide + lane % kPackSide;
        const int y = ty * kTile + pack / kPacksAcross * kPackSide + lane / kPackSide;
        if (x >= width || y >= height) continue;
        const int64_t pixel = int64_t(y) * width + x;
        for (int c = 0; c < 4; ++c) image[pixel * channels + c] = rgba[pack * kLanes + lane][c];
        for (int c = 4; c < channels; ++c) image[pixel * channels + c] = extra[c - 4][pack][lane];
        if (overdraw) overdraw[pixel] = drawn[pack * kLanes + lane];
      }
  }
}

template void baked_forward<float>(const float*, const float*, float, const Bins&, int, int, bool, const float*,
                                   const Atlas&, float*, int32_t*);
template void baked_forward<double>(const double*, const double*, double, const Bins&, int, int, bool, const double*,
                                    const Atlas&, double*, int32_t*);

}  // namespace bt
