// Shading and blending in one pass over the fragments, and the backward pass, without storing colours. Vectorised by
// block; texels fragment by fragment.
#include "ops/blend.h"

#include <numeric>
#include <optional>

#include "cpu/blocks.h"
#include "cpu/kernels.h"
#include "cpu/texel_patch.h"

namespace bt {

namespace {
template <class S> using Blended = BlendedSurfels<S, TileBlocks>;
template <class S> using Forward = BlendForward<S, TileBlocks>;
template <class S> using Backward = BlendBackward<S, TileBlocks>;

template <bool kMaps> constexpr int kChannels = channels_of(kMaps);

// Fragments of a surfel in a tile, ready for blending.
template <class S> class SurfelRun {
 public:
  using P = Lanes<S>;
  const BlockRun run;
  const TexelPatch<S> patch;
  const P beta, normal[3];

  SurfelRun(const Blended<S>& of, const BlockRun& run, bool prefetch)
      : SurfelRun(of, run, prefetch, of.geom + int64_t(run.surfel) * kGeom) {}
  SurfelRun(const SurfelRun&) = delete;

  const PatchFragments<S>& few() const { return few_; }
  BT_HD uint32_t textured(int64_t k) const { return patch.textured() ? textured_[k - run.first] : 0; }
  bool any_textured() const { return any_textured_; }
  // Returns the index of block k's first fragment among `few`.
  BT_HD int number(int64_t k) const { return int(k - run.first) * kLanes; }
  // Computes the colours of block k's fragments; 0 in other lanes, so that non-finite values stay in their own pixel.
  // `residual`: of the first fragment; null: from texels. `under`: written if any are textured.
  BT_HD void colors(const BlockPart& part, int64_t k, const S* residual, BlockTexels<S>& under, P* to) const {
    P rgb[3] = {P(patch.view.x), P(patch.view.y), P(patch.view.z)};
    if (const uint32_t lanes = textured(k)) {
      under = few_.texels(number(k));
      for (int c = 0; c < 3; ++c) rgb[c] = select(mask_of<S>(lanes), shaded(rgb[c], under.residual(c)), rgb[c]);
    }
    if (residual) {
      S own[3][kLanes] = {};
      for (uint32_t lanes = part.lanes; lanes; lanes &= lanes - 1)
        for (int c = 0; c < 3; ++c) own[c][__builtin_ctz(lanes)] = *residual++;
      for (int c = 0; c < 3; ++c) rgb[c] = shaded(rgb[c], load(own[c]));
    }
    for (int c = 0; c < 3; ++c) to[c] = select(mask_of<S>(part.lanes), rgb[c], P(S(0)));
  }

 private:
  SurfelRun(const Blended<S>& of, const BlockRun& run, bool prefetch, const S* g)
      : run(run),
        patch(of.table, run.surfel),
        beta(g[kBeta]),
        normal{P(g[kNx]), P(g[kNx + 1]), P(g[kNx + 2])},
        few_(patch) {
    if (!patch.textured()) return;
    const FragmentArrays<S>& f = of.fragments.f;
    each_block(of.fragments.layout, run, [&](int64_t k, int64_t at, const BlockPart& part) {
      const uint32_t lanes = part.lanes & bits(expand(f.weight + at, part.lanes) >= P(of.bound));
      textured_[k - run.first] = lanes, any_textured_ |= lanes != 0;
      if (!lanes) return;
      few_.locate(number(k), expand(f.uv + at, part.lanes), expand(f.uv + f.total + at, part.lanes));
      if (prefetch) each_lane(lanes, [&](int lane) { few_.prefetch(number(k) + lane); });
    });
  }

  uint32_t textured_[kBlocks];  // per block of the run; unset if the surfel has no texels
  bool any_textured_ = false;
  PatchFragments<S> few_;
};
// Prefetches a surfel's data for SurfelRun.
template <class S> BT_HD void prefetch_surfel(const Blended<S>& of, int64_t id) {
  const TexelTiles<S>& t = of.table;
  __builtin_prefetch(of.geom + id * kGeom), __builtin_prefetch(t.base + 3 * id), __builtin_prefetch(t.first + id);
  __builtin_prefetch(t.size + 2 * id), __builtin_prefetch(t.extent + id);
}

// Calls fn(SurfelRun) for runs in order; each is set up one run ahead, to prefetch its texels.
template <class S, class F>
BT_HD void each_surfel_run(const Blended<S>& of, const std::vector<BlockRun>& runs, F&& fn) {
  const int64_t n = int64_t(runs.size());
  std::optional<SurfelRun<S>> two[2];
  for (int64_t r = 0; r <= n; ++r) {
    if (r + 4 < n) prefetch_surfel(of, runs[r + 4].surfel);
    if (r < n) two[r & 1].emplace(of, runs[r], true);
    if (r > 0) fn(*two[(r - 1) & 1]);
  }
}

template <bool kMaps, class S> void forward(const Forward<S>& a) {
  using P = Lanes<S>;
  constexpr int channels = kChannels<kMaps>;
  const FragmentArrays<S>& f = a.of.fragments.f;
  const TileBlocks& layout = a.of.fragments.layout;
  parallel_tiles(layout.start, layout.tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    std::vector<BlockRun> runs;
    for (int64_t tile = first; tile < last; ++tile) {
      P sums[kBlocks][channels];
      for (auto& block : sums) std::fill(block, block + channels, P(S(0)));
      runs.clear();
      each_run(layout, tile, [&](const BlockRun& run) { runs.push_back(run); });
      each_surfel_run(a.of, runs, [&](const SurfelRun<S>& surfel) {
        each_block(layout, surfel.run, [&](int64_t k, int64_t at, const BlockPart& part) {
          const P weight = expand(f.weight + at, part.lanes);
          P colors[3];
          BlockTexels<S> under;
          surfel.colors(part, k, a.of.residual ? a.of.residual + 3 * at : nullptr, under, colors);
          const P depth = kMaps ? expand(f.depth + at, part.lanes) : P(S(0));
          add_blended<kMaps>(weight, colors, surfel.beta, depth, surfel.normal, sums[part.block]);
        });
      });
      each_pixel(tile, a.of.width, a.of.height, [&](int64_t pixel, int block, int lane) {
        for (int c = 0; c < channels; ++c) a.image[pixel * channels + c] = sums[block][c][lane];
      });
    }
  });
}

// A surfel's sums over fragments for its gradients: view colour and beta, and the normal with maps.
template <class T> struct Sums {
  T view[3], beta, normal[3];
  Sums() : beta(T(0.0f)) { std::fill(view, view + 3, beta), std::fill(normal, normal + 3, beta); }
};

// Computes the gradients of the fragments of a run. `rows`: gradients of the surfel's texels, rows of four, or null.
template <bool kMaps, class S>
void run_backward(const Backward<S>& a, const BlockPicture<S, kChannels<kMaps>>& dimage, const SurfelRun<S>& surfel,
                  S* rows, Sums<Lanes<S>>& sums) {
  using P = Lanes<S>;
  constexpr int channels = kChannels<kMaps>;
  const FragmentArrays<S>& f = a.of.fragments.f;
  const P zero = P(S(0));
  const int64_t end = surfel.run.end;
  each_block(a.of.fragments.layout, surfel.run, [&](int64_t block, int64_t at, const BlockPart& part) {
    const auto there = mask_of<S>(part.lanes);
    const P weight = expand(f.weight + at, part.lanes);
    P d[channels], colors[3], dcolors[3], du = zero, dv = zero;
    BlockTexels<S> under;
    for (int c = 0; c < channels; ++c)
      d[c] = select(there, load(dimage.numbers(surfel.run.tile, part.block) + c * kLanes), zero);
    surfel.colors(part, block, a.of.residual ? a.of.residual + 3 * at : nullptr, under, colors);
    const P depth = kMaps ? expand(f.depth + at, part.lanes) : zero;
    if (a.dweight)
      compress_until(a.dweight + end, a.dweight + at,
                     weight_gradient<kMaps>(d, colors, surfel.beta, depth, surfel.normal), part.lanes);
    for (int k = 0; k < 3; ++k) {
      dcolors[k] = residual_gradient(colors[k], weight * d[k]);
      sums.view[k] += dcolors[k];
    }
    sums.beta += weight * d[4];
    if constexpr (kMaps) {
      compress_until(a.ddepth + end, a.ddepth + at, weight * d[5], part.lanes);
      for (int k = 0; k < 3; ++k) sums.normal[k] += weight * d[6 + k];
    }
    const uint32_t textured = surfel.textured(block);
    S rgb[3][kLanes];
    if ((textured && rows) || a.dresidual)
      for (int k = 0; k < 3; ++k) store(rgb[k], dcolors[k]);
    if (S* to = a.dresidual ? a.dresidual + 3 * at : nullptr)
      for (uint32_t lanes = part.lanes; lanes; lanes &= lanes - 1)
        for (int k = 0; k < 3; ++k) *to++ = rgb[k][__builtin_ctz(lanes)];
    const int number = surfel.number(block);
    if (rows)
      each_lane(textured, [&](int lane) {
        const Four<S> dcolor(Vec3<S>{rgb[0][lane], rgb[1][lane], rgb[2][lane]}, S(0));
        surfel.few().add_gradient(number + lane, dcolor, rows);
      });
    if (!a.duv) return;
    if (textured) {
      const auto shows = mask_of<S>(textured);
      du = select(shows, surfel.few().gradient_u(number, under, dcolors), zero);
      dv = select(shows, surfel.few().gradient_v(number, under, dcolors), zero);
    }
    compress_until(a.duv + end, a.duv + at, du, part.lanes);
    compress_until(a.duv + f.total + end, a.duv + f.total + at, dv, part.lanes);
  });
}

template <bool kMaps, class S> Sums<S> total(const Sums<Lanes<S>>& of) {
  Sums<S> all;
  for (int k = 0; k < 3; ++k) {
    all.view[k] = sum(of.view[k]);
    if constexpr (kMaps) all.normal[k] = sum(of.normal[k]);
  }
  all.beta = sum(of.beta);
  return all;
}
template <class S> void add(const Sums<S>& one, Sums<S>& to) {
  for (int k = 0; k < 3; ++k) to.view[k] += one.view[k], to.normal[k] += one.normal[k];
  to.beta += one.beta;
}
template <class S> void surfel_backward(const Backward<S>& a, int64_t id, const Sums<S>& sums) {
  store3(a.dbase + 3 * id, base_gradient(load3(a.of.table.base + 3 * id), load3(sums.view)));
  S* dgeom = a.dgeom + id * kGeom;
  dgeom[kBeta] = sums.beta;
  for (int k = 0; k < 3; ++k) dgeom[kNx + k] = sums.normal[k];
}

// All runs of a list, in order.
class ListedRuns {
 public:
  explicit ListedRuns(const TileBlocks& layout) {
    std::vector<int64_t> before(layout.tiles + 1, 0);  // runs in earlier tiles
    const auto each_tile = [&](auto&& fn) {
      parallel_tiles(layout.block_start, layout.tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
        for (int64_t tile = first; tile < last; ++tile) fn(tile);
      });
    };
    each_tile([&](int64_t tile) { each_run(layout, tile, [&](const BlockRun&) { ++before[tile + 1]; }); });
    std::partial_sum(before.begin(), before.end(), before.begin());
    starts_.resize(before.back() + 1);
    each_tile([&](int64_t tile) {
      Start* to = starts_.data() + before[tile];
      each_run(layout, tile, [&](const BlockRun& run) { *to++ = {run.tile, run.surfel, run.begin, run.first}; });
    });
    starts_.back() = {0, 0, layout.fragments, layout.count};
  }
  int64_t count() const { return int64_t(starts_.size()) - 1; }
  int32_t surfel(int64_t r) const { return starts_[r].surfel; }
  int64_t length(int64_t r) const { return starts_[r + 1].begin - starts_[r].begin; }
  BlockRun run(int64_t r) const {
    const Start *s = &starts_[r], *next = s + 1;
    return {s->tile, s->surfel, s->begin, next->begin, s->first, next->first};
  }
  BT_HD void prefetch(int64_t r) const { __builtin_prefetch(&starts_[r]); }

 private:
  struct Start {
    int32_t tile, surfel;
    int64_t begin, first;
  };
  std::vector<Start> starts_;  // [runs + 1]
};

// Returns the runs grouped by surfel, surfels (at most n) in order of first appearance: consecutive ones are then
// neighbours on the screen, and their runs and pixels close together in memory.
std::vector<int64_t> by_surfel(const ListedRuns& runs, int64_t n) {
  std::vector<int32_t> rank(n, -1);
  std::vector<int64_t> next{0};  // number of runs of each rank, then the offset of its next one
  for (int64_t r = 0; r < runs.count(); ++r) {
    int32_t& its = rank[runs.surfel(r)];
    if (its < 0) its = int32_t(next.size()) - 1, next.push_back(0);
    ++next[its + 1];
  }
  std::partial_sum(next.begin(), next.end(), next.begin());
  std::vector<int64_t> order(runs.count());
  for (int64_t r = 0; r < runs.count(); ++r) order[next[rank[runs.surfel(r)]]++] = r;
  return order;
}

// Calls fn(k, last) for the runs order[k] to order[last - 1] of every surfel, in list order and by one thread, so that
// no other adds to its texels.
template <class F> void for_surfels(const ListedRuns& runs, const int64_t* order, F&& fn) {
  const int64_t count = runs.count();
  std::vector<int64_t> cost(count + 1, 0);
  for (int64_t k = 0; k < count; ++k) cost[k + 1] = cost[k] + runs.length(order[k]);
  const auto id = [&](int64_t k) { return runs.surfel(order[k]); };
  parallel_tiles(cost.data(), count, 1 << 20, [&](int, int64_t begin, int64_t end) {
    while (begin > 0 && begin < count && id(begin) == id(begin - 1)) ++begin;
    while (end < count && id(end) == id(end - 1)) ++end;
    for (int64_t k = begin, last; k < end; k = last) {
      for (last = k + 1; last < end && id(last) == id(k);) ++last;
      fn(k, last);
    }
  });
}

// Prefetches data of the runs after run k of `order`, which are scattered over the list: first their descriptions, then
// fragments and pixels. Always inlined: GCC drops calls of a function without other effects.
template <int channels, class S>
BT_HD void prefetch_next(const Backward<S>& a, const BlockPicture<S, channels>& dimage, const ListedRuns& listed,
                         const std::vector<int64_t>& order, int64_t k) {
  const FragmentArrays<S>& f = a.of.fragments.f;
  constexpr int64_t line = 64 / sizeof(S);
  const auto ahead = [&](int64_t by) { return order[std::min(k + by, int64_t(order.size()) - 1)]; };
  listed.prefetch(ahead(8));
  const BlockRun next = listed.run(ahead(3));
  __builtin_prefetch(a.of.fragments.layout.blocks + 2 * next.first);
  for (int64_t i = next.begin; i < next.end + line - 1; i += line) {
    const int64_t j = std::min(i, next.end - 1);
    __builtin_prefetch(f.weight + j), __builtin_prefetch(f.uv + j), __builtin_prefetch(f.uv + f.total + j);
    if (a.dweight) __builtin_prefetch(a.dweight + j, 1);
    if (a.duv) __builtin_prefetch(a.duv + j, 1), __builtin_prefetch(a.duv + f.total + j, 1);
  }
  const BlockRun soon = listed.run(ahead(1));
  for (int64_t p = soon.first; p < soon.last; ++p) {
    const S* numbers = dimage.numbers(soon.tile, BlockPart(a.of.fragments.layout, p).block);
    for (int64_t i = 0; i < channels * kLanes; i += line) __builtin_prefetch(numbers + i);
  }
}

// Moves texels by their gradients, rows of four with the last 0. Each store also rewrites a number of the next texel,
// so several are loaded together: loads of partly stored data stall.
template <class S> void move_texels(const S* rows, int64_t count, S rate, const S* share, S* texels) {
  constexpr int kTogether = 8;
  int64_t t = 0;
  for (; t + kTogether < count; t += kTogether) {
    Four<S> moved[kTogether];
    for (int k = 0; k < kTogether; ++k)
      moved[k] = texel_step(Four<S>::load(texels + 3 * (t + k)), Four<S>::load(rows + 4 * (t + k)), rate, share[t + k]);
    for (int k = 0; k < kTogether; ++k) moved[k].store(texels + 3 * (t + k));
  }
  for (; t < count; ++t) store3(texels + 3 * t, texel_step(load3(texels + 3 * t), load3(rows + 4 * t), rate, share[t]));
}
// Surfel by surfel: each thread adds to its own surfels' texels; also without, for equal gradients of surfels.
template <bool kMaps, class S>
void backward_by_surfel(const Backward<S>& a, const BlockPicture<S, kChannels<kMaps>>& dimage, const ListedRuns& listed,
                        const std::vector<int64_t>& order) {
  for_surfels(listed, order.data(), [&](int64_t first, int64_t last) {
    const int64_t id = listed.surfel(order[first]);
    const TexelPatch<S> patch(a.of.table, id);
    thread_local std::vector<S> own;  // texel gradients, rows of four
    const int64_t area = a.moved ? int64_t(patch.size[0]) * patch.size[1] : 0;
    bool moves = false;
    Sums<Lanes<S>> sums;
    for (int64_t k = first; k < last; ++k) {
      prefetch_next(a, dimage, listed, order, k);
      const SurfelRun<S> surfel(a.of, listed.run(order[k]), false);
      if (!moves && area && surfel.any_textured()) moves = true, own.assign(4 * area, S(0));
      run_backward<kMaps>(a, dimage, surfel, moves ? own.data() : nullptr, sums);
    }
    surfel_backward(a, id, total<kMaps>(sums));
    if (moves) move_texels(own.data(), area, a.rate, a.share + patch.first, a.moved + 3 * patch.first);
  });
}
// Run by run: faster without texels.
template <bool kMaps, class S>
void backward_by_run(const Backward<S>& a, const BlockPicture<S, kChannels<kMaps>>& dimage, const ListedRuns& listed,
                     const std::vector<int64_t>& order) {
  std::vector<Sums<S>> of_run(listed.count());
  parallel_each(listed.count(), 64, [&](int64_t r) {
    Sums<Lanes<S>> sums;
    run_backward<kMaps, S>(a, dimage, SurfelRun<S>(a.of, listed.run(r), false), nullptr, sums);
    of_run[r] = total<kMaps>(sums);
  });
  for_surfels(listed, order.data(), [&](int64_t first, int64_t last) {
    Sums<S> sums;
    for (int64_t k = first; k < last; ++k) add(of_run[order[k]], sums);
    surfel_backward(a, listed.surfel(order[first]), sums);
  });
}

template <bool kMaps, class S> void backward(const Backward<S>& a) {
  const TexelTiles<S>& table = a.of.table;
  std::fill(a.dgeom, a.dgeom + table.n * kGeom, S(0));
  std::fill(a.dbase, a.dbase + 3 * table.n, S(0));
  const BlockPicture<S, kChannels<kMaps>> dimage(a.dimage, a.of.width, a.of.height);
  const ListedRuns listed(a.of.fragments.layout);
  const std::vector<int64_t> order = by_surfel(listed, table.n);
  (table.texels ? backward_by_surfel<kMaps, S> : backward_by_run<kMaps, S>)(a, dimage, listed, order);
}
}  // namespace

template <class S> void blend_forward(const BlendForward<S, TileBlocks>& a) {
  a.of.maps ? forward<true>(a) : forward<false>(a);
}
template <class S> void blend_backward(const BlendBackward<S, TileBlocks>& a) {
  a.of.maps ? backward<true>(a) : backward<false>(a);
}

BT_INSTANTIATE(blend_forward, Forward)
BT_INSTANTIATE(blend_backward, Backward)

}  // namespace bt
