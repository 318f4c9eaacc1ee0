// Fragments of a view, their backward pass, and per-surfel counts.
#include <atomic>
#include <stdexcept>
#include <string>

#include "core/kernel.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"
#include "cpu/tile_state.h"

namespace bt {

namespace {
// Bound on a tile's fragments: each takes at least 1/255 of a transmittance that stays above 1e-4, i.e. at most 2344
// per pixel. Vector stores may go past the last one.
constexpr int64_t kTileMost = 2400 * kTile * kTile + kLanes;
constexpr int64_t kKept = int64_t(1) << 22;  // longest list that keeps its memory for the next view
template <class S> void list_fragments(const View<S>& view, const AlphaTiles<S>& alpha, int64_t most, Trace<S>& to) {
  using P = Lanes<S>;
  using Chunk = typename FoundFragments<S>::Chunk;
  const Bins& bins = to.bins;
  FoundFragments<S>& list = to.list;
  static_assert(kTileMost < Chunk::kSize, "a tile fits a chunk");
  const int64_t tiles = int64_t(bins.tiles_x) * bins.tiles_y;
  const int threads = num_threads();
  if (int(list.chunks.size()) < threads) list.chunks.resize(threads);
  for (auto& own : list.chunks)
    for (auto& chunk : own) chunk.used = chunk.used_blocks = 0;
  list.pieces.assign(tiles, {});
  std::vector<int> current(threads, 0);
  std::atomic<int64_t> found{0};
  const auto draw = [&](int thread, int64_t tile) {
    const bool keep = !most || found.load(std::memory_order_relaxed) <= most;
    auto& own = list.chunks[thread];
    int& at_chunk = current[thread];
    if (at_chunk < int(own.size()) && own[at_chunk].used + kTileMost > Chunk::kSize) ++at_chunk;
    if (at_chunk == int(own.size())) own.emplace_back(own.empty());
    Chunk& a = own[at_chunk];
    const int64_t from = a.used, from_block = a.used_blocks;
    int64_t count = 0, blocks = 0;
    each_surfel<true>(view, alpha, bins, tile, [&](int32_t id, auto&& blend) {
      blend([&](int block, const typename P::M& taken, const Fragment<P>& f, P weight) {
        const BlockPart part(bits(taken), block, id);
        if (keep) {
          const int64_t at = from + count;
          part.write(a.blocks + 2 * (from_block + blocks++));
          compress(&a.weight[at], weight, part.lanes);
          compress(&a.u[at], f.u, part.lanes);
          compress(&a.v[at], f.v, part.lanes);
          compress(&a.depth[at], f.depth, part.lanes);
          compress(&a.sigma[at], listed_sigma(f), part.lanes);
        }
        count += part.count();
      });
    });
    if (keep) a.used += count, a.used_blocks += blocks;
    found.fetch_add(count, std::memory_order_relaxed);
    list.pieces[tile] = {thread, at_chunk, from, count, from_block, blocks};
  };
  const auto draw_some = [&](const Member& m) {
    m.each(tiles, 4, [&](int64_t first, int64_t last) {
      for (int64_t tile = first; tile < last; ++tile) draw(m.index, tile);
    });
  };
  run_together(draw_some, threads);
  list.tile_start.assign(tiles + 1, 0), list.block_start.assign(tiles + 1, 0);
  for (int64_t t = 0; t < tiles; ++t) {
    list.tile_start[t + 1] = list.tile_start[t] + list.pieces[t].count;
    list.block_start[t + 1] = list.block_start[t] + list.pieces[t].blocks;
  }
  list.total = list.tile_start[tiles], list.blocks = list.block_start[tiles];
  if (most && list.total > most) list.chunks.clear(), list.blocks = 0;  // will not be copied
}
}  // namespace

template <class S> void trace_forward(const TraceForward<S>& a, Trace<S>& to) {
  const auto lists = binner(a.view, to.bins);
  run_together([&](const Member& m) { lists->run(m, nullptr); });
  list_fragments(a.view, a.alpha, a.most, to);
}

template <class S> void trace_copy(const TraceCopy<S>& a, Trace<S>& from) {
  FoundFragments<S>& list = from.list;
  const FragmentArrays<S>& out = a.out;
  if (list.total && list.chunks.empty()) throw std::logic_error("the fragments were counted only, or copied before");
  if (out.total != list.total || a.blocks_listed != list.blocks || a.starts != int64_t(list.tile_start.size()))
    throw std::invalid_argument("the list has " + std::to_string(list.total) + " fragments in " +
                                std::to_string(list.blocks) + " blocks of " +
                                std::to_string(list.tile_start.size() - 1) + " tiles");
  std::copy(list.tile_start.begin(), list.tile_start.end(), a.tile_start);
  std::copy(list.block_start.begin(), list.block_start.end(), a.block_start);
  std::vector<std::vector<int64_t>> tiles;  // with the k-th chunks of all threads
  for (size_t t = 0; t < list.pieces.size(); ++t) {
    const auto& p = list.pieces[t];
    if (!p.count) continue;
    tiles.resize(std::max(tiles.size(), size_t(p.chunk) + 1));
    tiles[p.chunk].push_back(int64_t(t));
  }
  const bool large = list.total > kKept;
  for (size_t k = 0; k < tiles.size(); ++k) {
    const auto copy = [&](int64_t tile) {
      const auto& p = list.pieces[tile];
      const auto& chunk = list.chunks[p.thread][k];
      const int64_t to = list.tile_start[tile];
      std::copy_n(chunk.weight + p.from, p.count, out.weight + to);
      std::copy_n(chunk.u + p.from, p.count, out.uv + to);
      std::copy_n(chunk.v + p.from, p.count, out.uv + list.total + to);
      std::copy_n(chunk.depth + p.from, p.count, out.depth + to);
      std::copy_n(chunk.sigma + p.from, p.count, out.sigma + to);
      std::copy_n(chunk.blocks + 2 * p.from_block, 2 * p.blocks, a.blocks + 2 * list.block_start[tile]);
    };
    parallel_each(int64_t(tiles[k].size()), 1, [&](int64_t i) { copy(tiles[k][i]); });
    if (!large) continue;
    for (auto& own : list.chunks)
      if (k < own.size()) own[k].memory.reset();  // at once, to avoid two copies of the list
  }
  if (large) list.chunks.clear();
}

template <class S> void trace_backward(const TraceBackward<S, TileBlocks>& a) {
  using P = Lanes<S>;
  const S *geom = a.view.geom, *dweight = a.dweight, *duv = a.duv, *ddepth = a.ddepth;
  const S near = a.view.near, rim = a.rim;
  const FragmentArrays<S>& f = a.fragments.f;
  const TileBlocks& layout = a.fragments.layout;
  const int64_t n = a.view.n, total = f.total, texels = a.dtexel_alpha ? a.alpha.texels : 0;
  S *dgeom = a.dgeom, *absgrad = a.absgrad;
  const int tiles_x = tiles_across(a.view.width);
  const int most =
      int(std::max<int64_t>(1, std::min<int64_t>(64, (int64_t(1) << 28) / std::max(n * kGeom + texels, int64_t(1)))));
  std::vector<std::vector<S>> partial(std::max(num_threads(), 1)), of_texels(partial.size());
  parallel_each(texels, 1 << 16, [&](int64_t t) { a.dtexel_alpha[t] = S(0); });
  std::fill(dgeom, dgeom + n * kGeom, S(0));
  std::fill(absgrad, absgrad + 2 * n, S(0));
  const BlockCentres<S> centres;
  const P zero = P(S(0));
  // Arrays and their prefetch distances: hardware does not predict runs, read from the list's end, each from its start.
  const S* columns[] = {f.sigma,
                        f.weight,
                        dweight,
                        duv,
                        duv ? duv + total : nullptr,
                        ddepth,
                        a.alpha.values ? f.uv : nullptr,
                        a.alpha.values ? f.uv + total : nullptr};
  constexpr int64_t kSoon = 256, kBlocksSoon = 6;
  // sums of a part: 14 numbers per surfel (12 columns of geom, two absolute gradients)
  constexpr int kColumns = kBeta + 1, kSums = kColumns + 2;
  const int parts = parallel_tiles(layout.start, layout.tiles, most, [&](int part, int64_t first, int64_t last) {
    std::vector<S>& sums = partial[part];
    sums.assign(n * kSums, S(0));
    of_texels[part].assign(part ? texels : 0, S(0));  // the first part adds directly to the result
    S* const dtexels = !texels ? nullptr : part ? of_texels[part].data() : a.dtexel_alpha;
    for (int64_t tile = first; tile < last; ++tile) {
      const S x0 = S(tile % tiles_x * kTile), y0 = S(tile / tiles_x * kTile);
      P behind[kBlocks];  // per pixel: sum of w dL/dw over the fragments behind
      std::fill(behind, behind + kBlocks, zero);
      each_run_back(layout, tile, [&](const BlockRun& run) {
        const auto ahead = [&](int64_t by) { return BlockPart(layout, std::max<int64_t>(run.first - by, 0)).surfel; };
        const int64_t id = run.surfel, next = ahead(kBlocksSoon);
        __builtin_prefetch(geom + next * kGeom), __builtin_prefetch(sums.data() + next * kSums, 1);
        if (a.alpha.values) {
          prefetch_tile(a.alpha, ahead(2 * kBlocksSoon));
          prefetch_texels<S>(a.alpha, next, dtexels);
        }
        const S* g = geom + id * kGeom;
        const S cx = g[kCx] - x0, cy = g[kCy] - y0;
        P d[kGeom], ax = zero, ay = zero;
        const bool has_alpha = a.alpha.values && a.alpha.size[2 * id] > 0;
        for (int k = 0; k < kColumns; ++k) d[k] = zero;
        each_block(layout, run, [&](int64_t, int64_t at, const BlockPart& of) {
          const auto there = mask_of<S>(of.lanes);
          const int64_t soon = std::max<int64_t>(at - kSoon, 0);
          for (const S* p : columns)
            if (p) __builtin_prefetch(p + soon);
          const auto gradient = [&](const S* p) { return p ? expand(p + at, of.lanes) : zero; };
          P listed = expand(f.sigma + at, of.lanes);
          const P sigma = abs_(listed);
          P dsigma = blend_vjp(expand(f.weight + at, of.lanes), sigma, gradient(dweight), behind[of.block]);
          const P dx = centres.x + P(kBlockOffsets<S>.column[of.block] - cx);
          const P dy = centres.y + P(kBlockOffsets<S>.row[of.block] - cy);
          P ddx, ddy, gu = gradient(duv), gv = gradient(duv ? duv + total : nullptr);
          if (has_alpha) {
            const P u = expand(f.uv + at, of.lanes), v = expand(f.uv + total + at, of.lanes);
            const AlphaPatch<S> patch(a.alpha, id);
            S* of_tile = dtexels ? dtexels + patch.first : nullptr;
            if (const uint32_t lanes = of.lanes & marks(v))
              AlphaLanes<S>(patch, u, v, lanes).gradient(listed, dsigma, gu, gv, of_tile);
          }
          fragment_vjp<S, P>(g, near, rim, select(there, dx, zero), select(there, dy, zero), listed,
                             select(there, dsigma, zero), gu, gv, gradient(ddepth), d, ddx, ddy);
          ax += abs_(ddx), ay += abs_(ddy);
        });
        S* to = sums.data() + id * kSums;
        for (int k = 0; k < kColumns; ++k) to[k] += sum(d[k]);
        to[kColumns] += sum(ax), to[kColumns + 1] += sum(ay);
      });
    }
  });
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int p = 0; p < parts; ++p) {
      for (int64_t i = begin; i < end; ++i) {
        const S* from = partial[p].data() + i * kSums;
        for (int k = 0; k < kColumns; ++k) dgeom[i * kGeom + k] += from[k];
        absgrad[2 * i] += from[kColumns], absgrad[2 * i + 1] += from[kColumns + 1];
      }
    }
  });
  parallel_parts(texels, 1 << 16, [&](int, int64_t begin, int64_t end) {
    for (int p = 1; p < parts; ++p)
      for (int64_t t = begin; t < end; ++t) a.dtexel_alpha[t] += of_texels[p][t];
  });
}

void list_ids(const ListedIds& a) {
  using Whole = Wide<int32_t>;
  Whole in_block;  // offsets of the pixels from the first one
  for (int lane = 0; lane < kLanes; ++lane) set_lane(in_block, lane, pixels_on(lane, a.width));
  parallel_tiles(a.layout.start, a.layout.tiles, 1 << 20, [&](int, int64_t first, int64_t last) {
    // memory behind belongs to another thread
    int32_t *const surfels = a.surfel + a.layout.start[last], *const pixels = a.pixel + a.layout.start[last];
    for (int64_t tile = first; tile < last; ++tile)
      each_run(a.layout, tile, [&](const BlockRun& run) {
        each_block(a.layout, run, [&](int64_t, int64_t at, const BlockPart& part) {
          const int32_t from = first_pixel(tile, part.block, a.width);
          compress_until(pixels, a.pixel + at, in_block + from, part.lanes);
          compress_until(surfels, a.surfel + at, all_lanes<Whole>(part.surfel), part.lanes);
        });
      });
  });
}

template <class S> void select_fragments(const SelectBlocks<S>& a) {
  const int64_t from = a.from.total, total = a.out.total;
  if (std::count_if(a.keep, a.keep + from, [](uint8_t keep) { return keep != 0; }) != total)
    throw std::invalid_argument("the selection has another number of fragments");
  int64_t fragments = 0, blocks = 0, at = 0;
  for (int64_t tile = 0; tile < a.layout.tiles; ++tile) {
    a.tile_start[tile] = fragments, a.block_start[tile] = blocks;
    for (int64_t k = a.layout.block_start[tile]; k < a.layout.block_start[tile + 1]; ++k) {
      const BlockPart part(a.layout, k);
      const int64_t first = at;
      uint32_t kept = 0;
      each_lane(part.lanes, [&](int lane) { kept |= uint32_t(a.keep[at++] != 0) << lane; });
      if (!kept) continue;
      const BlockPart left(kept, part.block, part.surfel);
      left.write(a.blocks + 2 * blocks++);
      const auto move = [&](const S* numbers, S* to, int64_t size) {
        compress_until(to + size, to + fragments, expand(numbers + first, part.lanes), kept);
      };
      move(a.from.weight, a.out.weight, total), move(a.from.depth, a.out.depth, total);
      move(a.from.sigma, a.out.sigma, total), move(a.from.uv, a.out.uv, total);
      move(a.from.uv + from, a.out.uv + total, total);
      fragments += left.count();
    }
  }
  a.tile_start[a.layout.tiles] = fragments, a.block_start[a.layout.tiles] = blocks;
}

void masked_counts(const MaskedCounts<TileBlocks>& a) {
  std::vector<std::vector<int32_t>> partial(std::max(num_threads(), 1));
  const int parts = parallel_tiles(a.layout.start, a.layout.tiles, 64, [&](int part, int64_t first, int64_t last) {
    std::vector<int32_t>& counts = partial[part];
    counts.assign(a.n, 0);
    for (int64_t tile = first; tile < last; ++tile)
      each_fragment(a.layout, tile, a.width,
                    [&](const BlockRun& run, int64_t, int64_t pixel) { counts[run.surfel] += a.mask[pixel] != 0; });
  });
  parallel_parts(a.n, 4096, [&](int, int64_t begin, int64_t end) {
    for (int p = 0; p < parts; ++p)
      for (int64_t i = begin; i < end; ++i) a.counts[i] += partial[p][i];
  });
}

template void trace_forward(const TraceForward<float>&, Trace<float>&);
template void trace_forward(const TraceForward<double>&, Trace<double>&);
BT_INSTANTIATE(select_fragments, SelectBlocks)
template void trace_copy(const TraceCopy<float>&, Trace<float>&);
template void trace_copy(const TraceCopy<double>&, Trace<double>&);
template void trace_backward(const TraceBackward<float, TileBlocks>&);
template void trace_backward(const TraceBackward<double, TileBlocks>&);

}  // namespace bt
