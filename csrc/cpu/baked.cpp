// Baked renderer: forward only, without fragment list, texels instead of the field.
#include <memory>
#include <stdexcept>
#include <string>

#include "core/blend.h"
#include "core/texel.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"
#include "cpu/tile_state.h"

namespace bt {

namespace {
// Red, green and blue of a texel per lane, and alpha with four channels.
template <class S, int channels> struct Texels {
  Lanes<S> of[channels];
};
// Texels at the lanes' offsets in a tile, and their right neighbours.
template <class S, int channels> struct TexelPairs {
  Texels<S, channels> left, right;
};

template <class S, int channels> inline Texels<S, channels> texels_of(const Wide<uint32_t>& rgba) {
  Texels<S, channels> t;
  for (int c = 0; c < channels; ++c) t.of[c] = from_integers<S>(rgba >> 8 * c & 255u);
  return t;
}
// Loads the texels at 16 offsets and their right neighbours, 8 bytes per pair.
inline void pairs_of(const uint8_t* patch, const int32_t* at, Wide<uint32_t>* left, Wide<uint32_t>* right) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  const auto eight = [&](const int32_t* offsets) {
    const __m256i p = _mm256_loadu_si256((const __m256i*)offsets);
    return _mm512_mask_i32gather_epi64(_mm512_setzero_si512(), __mmask8(0xff), p, patch, 4);
  };
  const __m512i low = eight(at), high = eight(at + 8);
  const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  const __m512i odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
  *left = (Wide<uint32_t>)_mm512_permutex2var_epi32(low, even, high);
  *right = (Wide<uint32_t>)_mm512_permutex2var_epi32(low, odd, high);
#elif defined(__AVX2__)
  const auto two = [&](int i) {
    const __m128i first = _mm_loadl_epi64((const __m128i*)(patch + 4 * int64_t(at[i])));
    int64_t second;
    std::memcpy(&second, patch + 4 * int64_t(at[i + 1]), sizeof second);
    return _mm_insert_epi64(first, second, 1);
  };
  const auto eight = [&](int i, Vector<uint32_t>& l, Vector<uint32_t>& r) {
    const __m256 a = (__m256)_mm256_set_m128i(two(i + 4), two(i)), b = (__m256)_mm256_set_m128i(two(i + 6), two(i + 2));
    l = (Vector<uint32_t>)_mm256_shuffle_ps(a, b, 0x88), r = (Vector<uint32_t>)_mm256_shuffle_ps(a, b, 0xdd);
  };
  eight(0, left->low, right->low), eight(8, left->high, right->high);
#else
  uint32_t pair[2];
  for (int i = 0; i < kLanes; ++i) {
    std::memcpy(pair, patch + 4 * int64_t(at[i]), sizeof pair);
    set_lane(*left, i, pair[0]), set_lane(*right, i, pair[1]);
  }
#endif
}
template <class S, int channels> inline TexelPairs<S, channels> texel_pairs(const uint8_t* patch, const int32_t* at) {
  Wide<uint32_t> left, right;
  pairs_of(patch, at, &left, &right);
  return {texels_of<S, channels>(left), texels_of<S, channels>(right)};
}
template <class S, int channels> inline TexelPairs<S, channels> texel_pairs(const float* patch, const int32_t* at) {
  TexelPairs<S, channels> t;
  for (int i = 0; i < kLanes; ++i)
    for (int c = 0; c < channels; ++c) {
      const float* p = patch + 4 * int64_t(at[i]) + c;
      t.left.of[c].set(i, S(p[0])), t.right.of[c].set(i, S(p[4]));
    }
  return t;
}

#if defined(__AVX2__)
// Interpolates along v between the texels at 16 offsets, or their right neighbours, and those `down` below.
template <int channels>
inline TexelPairs<float, channels> pairs_along_v(const float* patch, const int32_t* at, int64_t down, Lanes<float> fy) {
  alignas(64) float below[kLanes];
  store(below, fy);
  __m256 half[2 * channels][2];  // left, then right
  for (int h = 0; h < 2; ++h) {
    const auto pair = [&](int lane) {  // four numbers on the left, four on the right
      const float* p = patch + 4 * int64_t(at[8 * h + lane]);
      const Oct<float> top = (Oct<float>)_mm256_loadu_ps(p), bottom = (Oct<float>)_mm256_loadu_ps(p + down);
      return (__m256)(top + below[8 * h + lane] * (bottom - top));
    };
    __m256 left[4], right[4];  // of two lanes, four lanes apart
    for (int lane = 0; lane < 4; ++lane) {
      const __m256 a = pair(lane), b = pair(lane + 4);
      left[lane] = _mm256_permute2f128_ps(a, b, 0x20), right[lane] = _mm256_permute2f128_ps(a, b, 0x31);
    }
    const auto columns = [&](const __m256* rows, int first) {
      const __m256 a = _mm256_unpacklo_ps(rows[0], rows[1]), b = _mm256_unpacklo_ps(rows[2], rows[3]);
      const __m256 c = _mm256_unpackhi_ps(rows[0], rows[1]), d = _mm256_unpackhi_ps(rows[2], rows[3]);
      half[first][h] = _mm256_shuffle_ps(a, b, 0x44), half[first + 1][h] = _mm256_shuffle_ps(a, b, 0xee);
      half[first + 2][h] = _mm256_shuffle_ps(c, d, 0x44);
      if constexpr (channels == 4) half[first + 3][h] = _mm256_shuffle_ps(c, d, 0xee);
    };
    columns(left, 0), columns(right, channels);
  }
  TexelPairs<float, channels> t;
  for (int c = 0; c < channels; ++c) {
    t.left.of[c] = joined(half[c][0], half[c][1]);
    t.right.of[c] = joined(half[channels + c][0], half[channels + c][1]);
  }
  return t;
}
#endif

// Interpolates stored values bilinearly at the lanes' positions in a tile, clamped to the outer texel centres; in the
// last column and row the neighbour has weight 0 and may be any texel.
template <class S, int channels, class T>
inline Texels<S, channels> bilinear(const T* patch, int columns, Lanes<S> x, Lanes<S> y) {
  using P = Lanes<S>;
  const P x0 = floor_(x), y0 = floor_(y), fx = x - x0, fy = y - y0;
  int32_t at[kLanes];
  store_integers(at, y0 * P(S(columns)) + x0);  // exact: a tile has fewer than 2^24 texels
  TexelPairs<S, channels> pairs;
#if defined(__AVX2__)
  if constexpr (std::is_same_v<S, float> && std::is_same_v<T, float>) {
    pairs = pairs_along_v<channels>(patch, at, 4 * int64_t(columns), fy);
  } else
#endif
  {
    pairs = texel_pairs<S, channels>(patch, at);
    const auto bottom = texel_pairs<S, channels>(patch + 4 * columns, at);
    for (int c = 0; c < channels; ++c) {
      pairs.left.of[c] += fy * (bottom.left.of[c] - pairs.left.of[c]);
      pairs.right.of[c] += fy * (bottom.right.of[c] - pairs.right.of[c]);
    }
  }
  Texels<S, channels> t;
  for (int c = 0; c < channels; ++c) t.of[c] = pairs.left.of[c] + fx * (pairs.right.of[c] - pairs.left.of[c]);
  return t;
}
}  // namespace

void gather_patches(const Pages& a, Patches& out) {
  out.first.resize(a.n), out.sides.resize(2 * a.n);
  int64_t texels = 0;
  int widest = 0;
  for (int64_t i = 0; i < a.n; ++i) {
    const int32_t* t = a.tiles + 5 * i;
    const bool none = (!a.bytes && !a.floats) || t[3] == 0;
    const int columns = none ? 0 : t[3], rows = none ? 0 : t[4];
    if (!none && (t[0] < 0 || t[1] < 0 || t[2] < 0 || t[2] >= a.layers || columns < 1 || rows < 1 ||
                  int64_t(t[0]) + columns > a.width || int64_t(t[1]) + rows > a.height))
      throw std::invalid_argument("the tile of surfel " + std::to_string(i) + " does not lie on a page of the atlas");
    out.first[i] = texels, out.sides[2 * i] = columns, out.sides[2 * i + 1] = rows;
    texels += int64_t(columns) * rows;
    widest = std::max(widest, columns);
  }
  const int64_t size = 4 * (texels + widest + 2);  // a fetch at the last texel also reads neighbours, with weight 0
  out.bytes.assign(a.bytes ? size : 0, 0), out.floats.assign(a.floats ? size : 0, 0.0f);
  parallel_each(a.n, 64, [&](int64_t i) {
    const int32_t* t = a.tiles + 5 * i;
    const int64_t line = 4 * int64_t(out.sides[2 * i]);
    for (int row = 0; row < out.sides[2 * i + 1]; ++row) {
      const int64_t from = 4 * ((int64_t(t[2]) * a.height + t[1] + row) * a.width + t[0]);
      const int64_t to = 4 * out.first[i] + row * line;
      if (a.bytes) std::copy_n(a.bytes + from, line, out.bytes.data() + to);
      if (a.floats) std::copy_n(a.floats + from, line, out.floats.data() + to);
    }
  });
}

namespace {
// A surfel besides its row of geom, contiguous, as every tile it touches reads it.
template <class S> struct DrawnSurfel {
  S view[3];             // colour without residual
  S bound;               // fragments of smaller weight get no residual
  S flat[4];             // residual and alpha without texels
  bool cut;              // whether any alpha differs from 1
  S k;                   // 1 / side of the tile in scale units
  const Patches* level;  // null: no texels
  int64_t first;
  int32_t sides[2];
};

// Returns the level of a surfel's tile for a view; null: the mean only.
template <class S> const Patches* level_of(const BakedForward<S>& a, int64_t id, S extent) {
  const int32_t* sides = a.patches->sides.data() + 2 * id;
  if (!sides[0]) return nullptr;
  if (!a.coarser[0]) return a.patches;
  int level = tile_level(a.view.geom + id * kGeom, sides[0], sides[1], extent, a.view.photo_pixel);
  if (level == kTileLevels) return a.residual.mean_residual ? nullptr : a.patches;
  while (level && !(a.coarser[level - 1] && a.coarser[level - 1]->sides[2 * id])) --level;
  return level ? a.coarser[level - 1] : a.patches;
}

template <class S> DrawnSurfel<S> drawn_surfel(const BakedForward<S>& a, int64_t id) {
  const BakedResidual& atlas = a.residual;
  const S extent = atlas.extent ? S(atlas.extent[id]) : S(kSupport);
  DrawnSurfel<S> d;
  store3(d.view, view_base(load3(a.base + 3 * id)));
  for (int c = 0; c < 3; ++c) d.flat[c] = atlas.mean_residual ? S(atlas.mean_residual[3 * id + c]) : S(0);
  d.flat[3] = atlas.mean_alpha ? S(atlas.mean_alpha[id]) : S(1);
  d.k = S(1) / (S(2) * extent);
  d.level = level_of(a, id, extent);
  d.first = d.level ? 4 * d.level->first[id] : 0;
  for (int k = 0; k < 2; ++k) d.sides[k] = d.level ? d.level->sides[2 * id + k] : 0;
  d.cut = d.level ? atlas.alpha_scale != 0 : d.flat[3] != 1;
  const bool plain = !d.level && !d.cut && d.flat[0] == 0 && d.flat[1] == 0 && d.flat[2] == 0;
  d.bound = plain ? S(2) : S(atlas.weight_bound);  // no weight reaches 2
  return d;
}

// Fetches residuals at surfel coordinates, and alpha with four channels.
template <int channels, class S>
inline Texels<S, channels> texels_at(const DrawnSurfel<S>& d, Lanes<S> u, Lanes<S> v, const BakedResidual& atlas) {
  using P = Lanes<S>;
  Texels<S, channels> t;
  if (!d.level) {
    for (int c = 0; c < channels; ++c) t.of[c] = P(d.flat[c]);
    return t;
  }
  const P x = texel_position_scaled(u, S(d.sides[0] - 1), d.k), y = texel_position_scaled(v, S(d.sides[1] - 1), d.k);
  t = d.level->floats.empty() ? bilinear<S, channels>(d.level->bytes.data() + d.first, d.sides[0], x, y)
                              : bilinear<S, channels>(d.level->floats.data() + d.first, d.sides[0], x, y);
  for (int c = 0; c < 3; ++c) t.of[c] = P(S(atlas.offset)) + P(S(atlas.scale)) * t.of[c];
  if constexpr (channels == 4) t.of[3] = P(S(atlas.alpha_scale)) * t.of[3];
  return t;
}

template <class S> void prefetch_texels(const DrawnSurfel<S>& d) {
  if (!d.level || d.level->bytes.empty()) return;
  const uint8_t* p = d.level->bytes.data() + d.first;
  for (int line = 0; line < 4; ++line) __builtin_prefetch(p + 64 * line);
}

template <class Kernel, bool kMaps, class S> void baked_forward(const BakedForward<S>& a) {
  using P = Lanes<S>;
  const int width = a.view.width, height = a.view.height;
  const Bins& bins = *a.bins;
  const BakedResidual& atlas = a.residual;
  S* image = a.image;
  int32_t* overdraw = a.overdraw;
  constexpr int channels = kMaps ? kMapChannels : kBakedChannels;
  const S photo_pixel = a.view.photo_pixel, sharp = Resize<S>(photo_pixel).sharp;
  const std::unique_ptr<DrawnSurfel<S>[]> drawn(new DrawnSurfel<S>[a.view.n]);  // visible surfels only
  const auto draw = [&](int64_t tile) {
    const int tx = int(tile % bins.tiles_x), ty = int(tile / bins.tiles_x);
    TileState<S> state(tx, ty, width, height, S(atlas.transmittance_min));
    P sums[kMapChannels + 1][kBlocks];  // rgb, alpha, beta, depth, normal, overdraw
    for (auto& row : sums) std::fill(row, row + kBlocks, P(S(0)));
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_blocks; ++k) {
      const int64_t id = bins.surfels[k];
      if (k + kAhead < bins.start[tile + 1]) {
        prefetch(a.view, bins, bins.surfels[k + kAhead]);
        __builtin_prefetch(drawn.get() + bins.surfels[k + kAhead]);
      }
      if (k + 1 < bins.start[tile + 1]) prefetch_texels(drawn[bins.surfels[k + 1]]);
      const DrawnSurfel<S>& d = drawn[id];
      const auto add = [&](int block, const typename P::M& taken, const Fragment<P>& f, P weight, auto&& texels) {
        const typename P::M textures = taken & (weight >= P(d.bound));
        const P w = select(taken, weight, P(S(0)));
        P colour[3] = {P(d.view[0]), P(d.view[1]), P(d.view[2])};
        if (bits(textures)) {
          const auto& t = texels(f);
          for (int c = 0; c < 3; ++c) colour[c] = select(textures, shaded(colour[c], t.of[c]), colour[c]);
        }
        for (int c = 0; c < 3; ++c) sums[c][block] += w * colour[c];
        sums[3][block] += w;
        if constexpr (kMaps) {
          const S* g = a.view.geom + id * kGeom;
          sums[4][block] += w * P(g[kBeta]);
          sums[5][block] += select(taken, w * f.depth, P(S(0)));
          for (int c = 0; c < 3; ++c) sums[6 + c][block] += w * P(g[kNx + c]);
        }
        if (overdraw) sums[kMapChannels][block] += select(taken, P(S(1)), P(S(0)));
      };
      if (!d.cut) {
        const auto fetch = [&](const Fragment<P>& f) { return texels_at<3>(d, f.u, f.v, atlas); };
        state.template blend<Kernel, kMaps>(
            a.view, bins, id, [&](int block, const auto& taken, const auto& f, P w) { add(block, taken, f, w, fetch); },
            sharp);
        continue;
      }
      Texels<S, 4> fetched;  // of a block: a weight that suffices for a residual did so for alpha
      const auto cut = [&](Fragment<P>& f, const typename P::M& covered, const P& transmittance) {
        const typename P::M reaches = covered & (bt::blend(f.sigma, transmittance).weight >= P(d.bound));
        if (!bits(reaches)) return;
        fetched = texels_at<4>(d, f.u, f.v, atlas);
        f.sigma = select(reaches, alpha_cut(f.sigma, fetched.of[3]), f.sigma);
      };
      const auto kept = [&](const Fragment<P>&) -> const Texels<S, 4>& { return fetched; };
      state.template blend<Kernel, kMaps>(
          a.view, bins, id, [&](int block, const auto& taken, const auto& f, P w) { add(block, taken, f, w, kept); },
          sharp, cut);
    }
    each_pixel(tile, width, height, [&](int64_t pixel, int block, int lane) {
      S* to = image + pixel * channels;
      for (int c = 0; c < channels; ++c) to[c] = sums[c][block][lane];
      if (overdraw) overdraw[pixel] = int32_t(sums[kMapChannels][block][lane]);
    });
  };
  const std::unique_ptr<Binner<S>> lists = binner(a.view, *a.bins);
  run_together([&](const Member& m) {
    lists->run(m, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i)
        if (a.view.radii[2 * i] > S(0)) drawn[i] = drawn_surfel(a, i);
    });
    m.each(int64_t(bins.tiles_x) * bins.tiles_y, 4, [&](int64_t begin, int64_t end) {
      for (int64_t tile = begin; tile < end; ++tile) draw(tile);
    });
  });
}
}  // namespace

template <class S> void baked_forward(const BakedForward<S>& a) {
  with_kernel(float(a.view.photo_pixel), [&](auto kernel) {
    using Kernel = decltype(kernel);
    a.maps ? baked_forward<Kernel, true>(a) : baked_forward<Kernel, false>(a);
  });
}

BT_INSTANTIATE(baked_forward, BakedForward)

}  // namespace bt
