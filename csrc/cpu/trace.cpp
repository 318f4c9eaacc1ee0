// Fragments of a view and their backward pass; per-surfel counts.
#include <atomic>
#include <stdexcept>
#include <string>

#include "core/kernel.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"
#include "cpu/tiles.h"

namespace bt {

namespace {
// A tile cannot have more: every blended fragment takes at least 1/255 of a transmittance that stays above 1e-4, which
// makes 2344 of them per pixel. Vectors may be written past the last one.
constexpr int64_t kTileMost = 2400 * kTile * kTile + kLanes;
constexpr int64_t kKept = int64_t(1) << 22;  // lists up to this length keep their memory for the next view
}  // namespace

namespace {
template <class Kernel, class S>
void trace_forward(const View<S>& view, int64_t most, Trace<S>& to) {
  using P = Pack<S>;
  using Block = typename FoundFragments<S>::Block;
  const int width = view.width, height = view.height;
  const Bins& bins = to.bins;
  FoundFragments<S>& list = to.list;
  static_assert(kTileMost < Block::kSize, "a tile fits a block");
  const int64_t tiles = int64_t(bins.tiles_x) * bins.tiles_y;
  const int threads = num_threads();
  if (int(list.blocks.size()) < threads) list.blocks.resize(threads);
  for (auto& own : list.blocks)
    for (auto& block : own) block.used = block.used_packs = 0;
  list.pieces.assign(tiles, {});
  std::vector<int> current(threads, 0);
  std::atomic<int64_t> found{0};
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
  for (int64_t tile = 0; tile < tiles; ++tile) {
#if defined(_OPENMP)
    const int thread = omp_get_thread_num();
#else
    const int thread = 0;
#endif
    const bool keep = !most || found.load(std::memory_order_relaxed) <= most;
    auto& own = list.blocks[thread];
    int& at_block = current[thread];
    if (at_block < int(own.size()) && own[at_block].used + kTileMost > Block::kSize) ++at_block;
    if (at_block == int(own.size())) own.emplace_back(own.empty());
    Block& a = own[at_block];
    const int64_t from = a.used, from_pack = a.used_packs;
    int64_t count = 0, packs = 0;
    const int tx = int(tile % bins.tiles_x), ty = int(tile / bins.tiles_x);
    TileState<S> state(tx, ty, width, height);
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_packs; ++k) {
      if (k + kAhead < bins.start[tile + 1]) prefetch(view, bins, bins.surfels[k + kAhead]);
      const int32_t id = bins.surfels[k];
      const auto take = [&](int pack, const typename P::M& taken, const Fragment<P>& f, P weight) {
        const PackPart part(bits(taken), pack, id);
        if (keep) {
          const int64_t at = from + count;
          part.write(a.packs + 2 * (from_pack + packs++));
          compress(&a.weight[at], weight, part.lanes);
          compress(&a.u[at], f.u, part.lanes);
          compress(&a.v[at], f.v, part.lanes);
          compress(&a.depth[at], f.depth, part.lanes);
          compress(&a.sigma[at], listed_sigma(f), part.lanes);
        }
        count += part.count();
      };
      state.template blend<Kernel, true>(view, bins, id, take);
    }
    if (keep) a.used += count, a.used_packs += packs;
    found.fetch_add(count, std::memory_order_relaxed);
    list.pieces[tile] = {thread, at_block, from, count, from_pack, packs};
  }
  list.tile_start.assign(tiles + 1, 0), list.pack_start.assign(tiles + 1, 0);
  for (int64_t t = 0; t < tiles; ++t) {
    list.tile_start[t + 1] = list.tile_start[t] + list.pieces[t].count;
    list.pack_start[t + 1] = list.pack_start[t] + list.pieces[t].packs;
  }
  list.total = list.tile_start[tiles], list.packs = list.pack_start[tiles];
  if (most && list.total > most) list.blocks.clear(), list.packs = 0;  // nothing will be copied
}
}  // namespace

template <class S>
void trace_forward(const TraceForward<S>& a, Trace<S>& to) {
  const auto lists = binner(a.view, to.bins);
  run_together([&](const Member& m) { lists->run(m, nullptr); });
  with_kernel(a.view.through_pixel, [&](auto kernel) { trace_forward<decltype(kernel)>(a.view, a.most, to); });
}

template <class S>
void trace_copy(const TraceCopy<S>& a, Trace<S>& from) {
  FoundFragments<S>& list = from.list;
  const FragmentArrays<S>& out = a.out;
  if (list.total && list.blocks.empty()) throw std::logic_error("the fragments were counted only, or copied before");
  if (out.total != list.total || a.packs_listed != list.packs || a.starts != int64_t(list.tile_start.size()))
    throw std::invalid_argument("the list has " + std::to_string(list.total) + " fragments in " +
                                std::to_string(list.packs) + " packs of " + std::to_string(list.tile_start.size() - 1) +
                                " tiles");
  std::copy(list.tile_start.begin(), list.tile_start.end(), a.tile_start);
  std::copy(list.pack_start.begin(), list.pack_start.end(), a.pack_start);
  std::vector<std::vector<int64_t>> tiles;  // of the k-th blocks of all threads
  for (size_t t = 0; t < list.pieces.size(); ++t) {
    const auto& p = list.pieces[t];
    if (!p.count) continue;
    tiles.resize(std::max(tiles.size(), size_t(p.block) + 1));
    tiles[p.block].push_back(int64_t(t));
  }
  const bool large = list.total > kKept;
  for (size_t k = 0; k < tiles.size(); ++k) {
#pragma omp parallel for num_threads(num_threads()) schedule(static)
    for (int64_t i = 0; i < int64_t(tiles[k].size()); ++i) {
      const auto& p = list.pieces[tiles[k][i]];
      const auto& block = list.blocks[p.thread][k];
      const int64_t to = list.tile_start[tiles[k][i]];
      std::copy_n(block.weight + p.from, p.count, out.weight + to);
      std::copy_n(block.u + p.from, p.count, out.uv + to);
      std::copy_n(block.v + p.from, p.count, out.uv + list.total + to);
      std::copy_n(block.depth + p.from, p.count, out.depth + to);
      std::copy_n(block.sigma + p.from, p.count, out.sigma + to);
      std::copy_n(block.packs + 2 * p.from_pack, 2 * p.packs, a.packs + 2 * list.pack_start[tiles[k][i]]);
    }
    if (!large) continue;
    for (auto& own : list.blocks)
      if (k < own.size()) own[k].memory.reset();  // at once, so that the list is not there twice
  }
  if (large) list.blocks.clear();
}

namespace {
template <class Kernel, class S>
void trace_backward(const TraceBackward<S, TilePacks>& a) {
  using P = Pack<S>;
  const S *geom = a.view.geom, *dweight = a.dweight, *duv = a.duv, *ddepth = a.ddepth;
  const S near = a.view.near, rim = a.rim;
  const FragmentArrays<S>& f = a.fragments.f;
  const TilePacks& layout = a.fragments.layout;
  const int64_t n = a.view.n, total = f.total;
  S *dgeom = a.dgeom, *absgrad = a.absgrad;
  const int tiles_x = tiles_across(a.view.width);
  const int most =
      int(std::max<int64_t>(1, std::min<int64_t>(64, (int64_t(1) << 28) / std::max<int64_t>(n, 1) / kGeom)));
  std::vector<std::vector<S>> partial(std::max(num_threads(), 1));
  std::fill(dgeom, dgeom + n * kGeom, S(0));
  std::fill(absgrad, absgrad + 2 * n, S(0));
  const PackCentres<S> centres;
  const P zero = P(S(0));
  // What is read, and how far ahead it is asked for: runs are read from the list's end, each from its start, which the
  // processor does not foresee.
  const S* columns[] = {f.sigma, f.weight, dweight, duv, duv ? duv + total : nullptr, ddepth};
  constexpr int64_t kSoon = 256, kPacksSoon = 6;
  // a part's own sums: 15 numbers per surfel (12 columns of geom, the area, and the two absolute gradients)
  constexpr int kColumns = kBeta + 1, kSums = kColumns + 3;
  const int parts = parallel_tiles(layout.start, layout.tiles, most, [&](int part, int64_t first, int64_t last) {
    std::vector<S>& sums = partial[part];
    sums.assign(n * kSums, S(0));
    for (int64_t tile = first; tile < last; ++tile) {
      const S x0 = S(tile % tiles_x * kTile), y0 = S(tile / tiles_x * kTile);
      P behind[kPacks];  // per pixel: sum of w dL/dw over the fragments behind
      std::fill(behind, behind + kPacks, zero);
      each_run_back(layout, tile, [&](const PackRun& run) {
        const int64_t id = run.surfel, next = PackPart(layout, std::max<int64_t>(run.first - kPacksSoon, 0)).surfel;
        __builtin_prefetch(geom + next * kGeom), __builtin_prefetch(sums.data() + next * kSums, 1);
        const S* g = geom + id * kGeom;
        const S cx = g[kCx] - x0, cy = g[kCy] - y0;
        P d[kGeom], ax = zero, ay = zero;
        for (int k = 0; k < kColumns; ++k) d[k] = zero;
        d[kArea] = zero;
        each_pack(layout, run, [&](int64_t, int64_t at, const PackPart& of) {
          const auto there = mask_of<S>(of.lanes);
          const int64_t soon = std::max<int64_t>(at - kSoon, 0);
          for (const S* p : columns)
            if (p) __builtin_prefetch(p + soon);
          const auto given = [&](const S* p) { return p ? expand(p + at, of.lanes) : zero; };
          const P listed = expand(f.sigma + at, of.lanes), sigma = abs_(listed);
          const P dsigma = blend_vjp(expand(f.weight + at, of.lanes), sigma, given(dweight), behind[of.pack]);
          const P dx = centres.x + P(kPackOffsets<S>.column[of.pack] - cx);
          const P dy = centres.y + P(kPackOffsets<S>.row[of.pack] - cy);
          P ddx, ddy;
          fragment_vjp<Kernel, S, P>(g, near, rim, select(there, dx, zero), select(there, dy, zero), listed,
                                     select(there, dsigma, zero), given(duv), given(duv ? duv + total : nullptr),
                                     given(ddepth), d, ddx, ddy);
          ax += abs_(ddx), ay += abs_(ddy);
        });
        S* to = sums.data() + id * kSums;
        for (int k = 0; k < kColumns; ++k) to[k] += sum(d[k]);
        to[kColumns] += sum(ax), to[kColumns + 1] += sum(ay);
        to[kColumns + 2] += sum(d[kArea]);
      });
    }
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int p = 0; p < parts; ++p) {
      for (int64_t i = begin; i < end; ++i) {
        const S* from = partial[p].data() + i * kSums;
        for (int k = 0; k < kColumns; ++k) dgeom[i * kGeom + k] += from[k];
        absgrad[2 * i] += from[kColumns], absgrad[2 * i + 1] += from[kColumns + 1];
        dgeom[i * kGeom + kArea] += from[kColumns + 2];
      }
    }
  });
}
}  // namespace

template <class S>
void trace_backward(const TraceBackward<S, TilePacks>& a) {
  with_kernel(a.view.through_pixel, [&](auto kernel) { trace_backward<decltype(kernel)>(a); });
}

void list_places(const ListedPlaces& a) {
  using Whole = Wide<int32_t>;
  Whole in_pack;  // the pixels, from the first one on
  for (int lane = 0; lane < kLanes; ++lane) set_lane(in_pack, lane, pixels_on(lane, a.width));
  parallel_tiles(a.layout.start, a.layout.tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    // what lies behind belongs to another thread
    int32_t *const surfels = a.surfel + a.layout.start[last], *const pixels = a.pixel + a.layout.start[last];
    for (int64_t tile = first; tile < last; ++tile)
      each_run(a.layout, tile, [&](const PackRun& run) {
        each_pack(a.layout, run, [&](int64_t, int64_t at, const PackPart& part) {
          const int32_t from = first_pixel(tile, part.pack, a.width);
          compress_until(pixels, a.pixel + at, in_pack + from, part.lanes);
          compress_until(surfels, a.surfel + at, all_lanes<Whole>(part.surfel), part.lanes);
        });
      });
  });
}

void select_fragments(const SelectPacks& a) {
  int64_t fragments = 0, packs = 0;
  const uint8_t* keep = a.keep;
  for (int64_t tile = 0; tile < a.layout.tiles; ++tile) {
    a.tile_start[tile] = fragments, a.pack_start[tile] = packs;
    for (int64_t k = a.layout.pack_start[tile]; k < a.layout.pack_start[tile + 1]; ++k) {
      const PackPart part(a.layout, k);
      uint32_t kept = 0;
      for (uint32_t lanes = part.lanes; lanes; lanes &= lanes - 1)
        if (*keep++) kept |= lanes & -lanes;
      if (!kept) continue;
      const PackPart left(kept, part.pack, part.surfel);
      left.write(a.packs + 2 * packs++);
      fragments += left.count();
    }
  }
  a.tile_start[a.layout.tiles] = fragments, a.pack_start[a.layout.tiles] = packs;
}

void masked_counts(const MaskedCounts<TilePacks>& a) {
  for (int64_t tile = 0; tile < a.layout.tiles; ++tile)
    each_fragment(a.layout, tile, a.width,
                  [&](const PackRun& run, int64_t, int64_t pixel) { a.counts[run.surfel] += a.mask[pixel] != 0; });
}

#define BT_INSTANTIATE(S)                                         \
  template void trace_forward(const TraceForward<S>&, Trace<S>&); \
  template void trace_copy(const TraceCopy<S>&, Trace<S>&);       \
  template void trace_backward(const TraceBackward<S, TilePacks>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
