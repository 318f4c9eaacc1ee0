// Coverage of surfels and texels in a view, without a list of its fragments.
#include "core/kernel.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"
#include "cpu/tile_state.h"

namespace bt {

namespace {
// Numbers in the sums of all parts but the first, at most.
constexpr int64_t kMostSums = int64_t(1) << 28;

// Calls fn(sums, tile) for every tile. Each part of the tiles has its own sums [rows, width]; the first adds to `out`,
// and reduce(to, from) adds a row of the others' to it.
template <class S, class F, class Reduce>
void each_part(const View<S>& view, Bins& bins, S* out, int64_t rows, int64_t width, F&& fn, Reduce&& reduce) {
  const auto lists = binner(view, bins);
  run_together([&](const Member& m) { lists->run(m, nullptr); });
  const int64_t numbers = rows * width;
  const int most = int(std::max<int64_t>(1, std::min<int64_t>(64, kMostSums / std::max<int64_t>(numbers, 1))));
  std::vector<std::vector<S>> others(std::max(num_threads(), 1));
  const int parts =
      parallel_tiles(bins.start.data(), bins.start.size() - 1, most, [&](int part, int64_t first, int64_t last) {
        if (part) others[part].assign(numbers, S(0));
        for (int64_t tile = first; tile < last; ++tile) fn(part ? others[part].data() : out, tile);
      });
  parallel_parts(rows, 1024, [&](int, int64_t begin, int64_t end) {
    for (int part = 1; part < parts; ++part)
      for (int64_t row = begin; row < end; ++row) reduce(out + width * row, others[part].data() + width * row);
  });
}
}  // namespace

template <class S> void surfel_coverage(const SurfelCoverage<S>& a) {
  using P = Lanes<S>;
  const auto add = [&](S* sums, int64_t tile) {
    each_surfel<false>(a.view, a.alpha, *a.bins, tile, [&](int32_t id, auto&& blend) {
      const P zero = P(S(0));
      P largest = zero, weights = zero, squares = zero;
      blend([&](int, const typename P::M& taken, const Fragment<P>& f, P weight) {
        const P shown = select(taken, weight, zero);
        largest = max_(largest, select(taken, weight / f.sigma, zero));
        weights += select(taken & (weight >= P(a.bound)), weight, zero);
        squares += shown * shown;
      });
      S most = largest[0];
      for (int lane = 1; lane < kLanes; ++lane) most = max_(most, largest[lane]);
      S* to = sums + 3 * int64_t(id);
      to[0] = max_(to[0], most), to[1] += sum(weights), to[2] += sum(squares);
    });
  };
  each_part(a.view, *a.bins, a.shown, a.view.n, 3, add,
            [](S* to, const S* from) { to[0] = max_(to[0], from[0]), to[1] += from[1], to[2] += from[2]; });
}

namespace {
// Weight and squared weight of a texel: loaded and stored together.
template <class S> struct PairOf;
template <> struct PairOf<float> {
  typedef float type __attribute__((vector_size(2 * sizeof(float))));
};
template <> struct PairOf<double> {
  typedef double type __attribute__((vector_size(2 * sizeof(double))));
};
template <class S> using Pair = typename PairOf<S>::type;
template <class S> BT_HD void add_pair(Pair<S> pair, S* to) {
  Pair<S> sum;
  std::memcpy(&sum, to, sizeof sum);
  sum += pair;
  std::memcpy(to, &sum, sizeof sum);
}
}  // namespace

template <class S> void texel_coverage(const TexelCoverage<S>& a) {
  using P = Lanes<S>;
  const auto add = [&](S* sums, int64_t tile) {
    uint32_t counts[kBlocks];  // masks of the blocks' pixels that count
    std::fill(counts, counts + kBlocks, ~uint32_t(0));
    if (a.mask)
      each_pixel(tile, a.view.width, a.view.height, [&](int64_t pixel, int block, int lane) {
        if (!a.mask[pixel]) counts[block] &= ~(uint32_t(1) << lane);
      });
    each_surfel<false>(a.view, a.alpha, *a.bins, tile, [&](int32_t id, auto&& blend) {
      const int32_t* size = a.size + 2 * int64_t(id);
      S* const to = sums + 2 * a.first[id];
      __builtin_prefetch(to, 1);
      blend([&](int block, const typename P::M& taken, const Fragment<P>& f, P weight) {
        const uint32_t lanes = bits(taken & (weight >= P(a.bound))) & counts[block];
        if (!lanes || !size[0]) return;
        const TexelAxis<P> x = texel_axis(f.u, size[0], a.extent[id]), y = texel_axis(f.v, size[1], a.extent[id]);
        const P first = y.first * P(S(size[0])) + x.first;
        int32_t at[kLanes];
        S weights[kLanes], across[kLanes], down[kLanes];
        store_integers(at, select(mask_of<S>(lanes), first, P(S(0))));
        store(weights, weight), store(across, x.fraction), store(down, y.fraction);
        const TexelSteps next(size);
        each_lane(lanes, [&](int lane) {
          const Pair<S> both = {weights[lane], weights[lane] * weights[lane]};
          const Pair<S> below = down[lane] * both, above = both - below;
          const Pair<S> below_right = across[lane] * below, above_right = across[lane] * above;
          S* const texel = to + 2 * int64_t(at[lane]);
          add_pair<S>(above - above_right, texel), add_pair<S>(above_right, texel + 2 * next.right);
          add_pair<S>(below - below_right, texel + 2 * next.down);
          add_pair<S>(below_right, texel + 2 * (next.down + next.right));
        });
      });
    });
  };
  each_part(a.view, *a.bins, a.covered, a.texels, 2, add,
            [](S* to, const S* from) { to[0] += from[0], to[1] += from[1]; });
}

BT_INSTANTIATE(surfel_coverage, SurfelCoverage)
BT_INSTANTIATE(texel_coverage, TexelCoverage)

}  // namespace bt
