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
    for (auto& block : own) block.used = 0;
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
    const int64_t from = a.used;
    int64_t count = 0;
    const int tx = int(tile % bins.tiles_x), ty = int(tile / bins.tiles_x);
    TileState<S> state(tx, ty, width, height);
    for (int64_t k = bins.start[tile]; k < bins.start[tile + 1] && state.open_packs; ++k) {
      const int32_t id = bins.surfels[k];
      state.template blend<Kernel, true>(
          view, bins, id, [&](int pack, const typename P::M& taken, const Fragment<P>& f, P weight) {
            const uint32_t lanes = bits(taken);
            if (!keep) {
              count += __builtin_popcount(lanes);
              return;
            }
            const int64_t at = from + count;
            const int32_t corner = (ty * kTile + pack_row(pack)) * width + tx * kTile + pack_column(pack);
            int n = 0;
            for (uint32_t rest = lanes; rest; rest &= rest - 1, ++n) {
              const int lane = __builtin_ctz(rest);
              a.pixel[at + n] = corner + lane / kPackSide * width + lane % kPackSide;
              a.surfel[at + n] = id;
            }
            compress(&a.weight[at], weight, lanes);
            compress(&a.u[at], f.u, lanes);
            compress(&a.v[at], f.v, lanes);
            compress(&a.depth[at], f.depth, lanes);
            compress(&a.sigma[at], listed_sigma(f), lanes);
            count += n;
          });
    }
    if (keep) a.used += count;
    found.fetch_add(count, std::memory_order_relaxed);
    list.pieces[tile] = {thread, at_block, from, count};
  }
  list.tile_start.assign(tiles + 1, 0);
  for (int64_t t = 0; t < tiles; ++t) list.tile_start[t + 1] = list.tile_start[t] + list.pieces[t].count;
  list.total = list.tile_start[tiles];
  if (most && list.total > most) list.blocks.clear();  // nothing will be copied
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
  if (out.total != list.total || a.starts != int64_t(list.tile_start.size()))
    throw std::invalid_argument("the list has " + std::to_string(list.total) + " fragments in " +
                                std::to_string(list.tile_start.size() - 1) + " tiles");
  std::copy(list.tile_start.begin(), list.tile_start.end(), a.tile_start);
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
      std::copy_n(block.surfel + p.from, p.count, out.surfel + to);
      std::copy_n(block.pixel + p.from, p.count, out.pixel + to);
      std::copy_n(block.weight + p.from, p.count, out.weight + to);
      std::copy_n(block.u + p.from, p.count, out.uv + to);
      std::copy_n(block.v + p.from, p.count, out.uv + list.total + to);
      std::copy_n(block.depth + p.from, p.count, out.depth + to);
      std::copy_n(block.sigma + p.from, p.count, out.sigma + to);
    }
    if (!large) continue;
    for (auto& own : list.blocks)
      if (k < own.size()) own[k].memory.reset();  // at once, so that the list is not there twice
  }
  if (large) list.blocks.clear();
}

namespace {
template <class Kernel, class S>
void trace_backward(const TraceBackward<S, TileStarts>& a) {
  using P = Pack<S>;
  const S *geom = a.view.geom, *dweight = a.dweight, *duv = a.duv, *ddepth = a.ddepth;
  const S near = a.view.near, rim = a.rim;
  const FragmentArrays<S>& f = a.fragments.f;
  const int64_t *tile_start = a.fragments.layout.start, tiles = a.fragments.layout.tiles;
  const int64_t n = a.view.n, total = f.total;
  const int width = a.view.width;
  S *dgeom = a.dgeom, *absgrad = a.absgrad;
  const int tiles_x = tiles_across(width);
  const int most =
      int(std::max<int64_t>(1, std::min<int64_t>(64, (int64_t(1) << 28) / std::max<int64_t>(n, 1) / kGeom)));
  std::vector<std::vector<S>> partial(std::max(num_threads(), 1));
  std::fill(dgeom, dgeom + n * kGeom, S(0));
  std::fill(absgrad, absgrad + 2 * n, S(0));
  // a part's own sums: 15 numbers per surfel (12 columns of geom, the area, and the two absolute gradients)
  constexpr int kColumns = kBeta + 1, kSums = kColumns + 3;
  const int parts = parallel_tiles(tile_start, tiles, most, [&](int part, int64_t first_tile, int64_t last_tile) {
    std::vector<S>& sums = partial[part];
    sums.assign(n * kSums, S(0));
    S behind[kTile * kTile];  // per pixel: sum of w dL/dw over the fragments behind
    S dsigma[kTile * kTile + kLanes], du[kTile * kTile + kLanes], dv[kTile * kTile + kLanes];
    S dz[kTile * kTile + kLanes], dx[kTile * kTile + kLanes], dy[kTile * kTile + kLanes];
    S low[kTile * kTile + kLanes];
    for (int64_t tile = first_tile; tile < last_tile; ++tile) {
      const int x0 = int(tile % tiles_x) * kTile, y0 = int(tile / tiles_x) * kTile;
      std::fill(behind, behind + kTile * kTile, S(0));
      int64_t end = tile_start[tile + 1];
      while (end > tile_start[tile]) {
        const int32_t id = f.surfel[end - 1];
        const S* g = geom + int64_t(id) * kGeom;
        int64_t begin = end;
        int m = 0;
        while (begin > tile_start[tile] && f.surfel[begin - 1] == id) {
          const int64_t i = --begin;
          const int y = f.pixel[i] / width, x = f.pixel[i] - y * width;
          S& rest = behind[(y - y0) * kTile + x - x0];
          const S gw = dweight ? dweight[i] : S(0);
          dsigma[m] = blend_vjp(f.weight[i], abs_(f.sigma[i]), gw, rest);
          du[m] = duv ? duv[i] : S(0), dv[m] = duv ? duv[total + i] : S(0);
          dz[m] = ddepth ? ddepth[i] : S(0);
          low[m] = low_pass_of(f.sigma[i]);
          dx[m] = pixel_centre<S>(x) - g[kCx], dy[m] = pixel_centre<S>(y) - g[kCy];
          ++m;
        }
        end = begin;
        for (int k = m; k % kLanes; ++k) dsigma[k] = du[k] = dv[k] = dz[k] = dx[k] = dy[k] = S(0), low[k] = S(1);
        P d[kGeom], ax = P(S(0)), ay = P(S(0));
        for (int k = 0; k < kColumns; ++k) d[k] = P(S(0));
        d[kArea] = P(S(0));
        for (int k = 0; k < m; k += kLanes) {
          P ddx, ddy;
          fragment_vjp<Kernel, S, P>(g, near, rim, load(dx + k), load(dy + k), load(low + k), load(dsigma + k),
                                     load(du + k), load(dv + k), load(dz + k), d, ddx, ddy);
          ax += abs_(ddx), ay += abs_(ddy);
        }
        S* to = sums.data() + int64_t(id) * kSums;
        for (int k = 0; k < kColumns; ++k) to[k] += sum(d[k]);
        to[kColumns] += sum(ax), to[kColumns + 1] += sum(ay);
        to[kColumns + 2] += sum(d[kArea]);
      }
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
void trace_backward(const TraceBackward<S, TileStarts>& a) {
  with_kernel(a.view.through_pixel, [&](auto kernel) { trace_backward<decltype(kernel)>(a); });
}

void masked_counts(const MaskedCounts<TileStarts>& a) {
  for (int64_t i = 0; i < a.fragments; ++i) a.counts[a.surfel[i]] += a.mask[a.pixel[i]] != 0;
}

#define BT_INSTANTIATE(S)                                         \
  template void trace_forward(const TraceForward<S>&, Trace<S>&); \
  template void trace_copy(const TraceCopy<S>&, Trace<S>&);       \
  template void trace_backward(const TraceBackward<S, TileStarts>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
