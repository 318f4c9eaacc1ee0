// Tile lists: of every tile the surfels that may touch it, front to back.
#include <cstring>
#include <numeric>

#include "core/resize.h"
#include "cpu/kernels.h"
#include "cpu/pack_extent.h"
#include "cpu/threads.h"
#include "cpu/tiles.h"

namespace bt {

namespace {
// The tile that holds the box of a surfel, as most of small ones: no row of it has to be looked at. -1: there are more.
template <class S>
int only_tile(const S* g, const S* radii, const Bins& bins) {
  const S x = g[kCx] - S(0.5), y = g[kCy] - S(0.5), side = S(kTile);
  const S column = floor_((x - radii[0]) / side), row = floor_((y - radii[1]) / side);
  if (!(column >= S(0) && row >= S(0) && column < S(bins.tiles_x) && row < S(bins.tiles_y))) return -1;
  if (!(x + radii[0] < (column + S(1)) * side - S(1) && y + radii[1] < (row + S(1)) * side - S(1))) return -1;
  return int(row) * bins.tiles_x + int(column);
}

// Sorted by depth; those of the same depth keep their order.
template <class S>
void sort_by_depth(std::vector<std::pair<S, int32_t>>& order) {
  std::sort(order.begin(), order.end());
}
// Depths in front of the camera are ordered as their bits are: three times into places by eleven of them.
void sort_by_depth(std::vector<std::pair<float, int32_t>>& order) {
  constexpr int kBits = 11, kPlaces = 1 << kBits, kRounds = 3;
  const auto digit = [](float depth, int round) {
    uint32_t bits;
    std::memcpy(&bits, &depth, sizeof bits);
    return bits >> kBits * round & (kPlaces - 1);
  };
  std::vector<uint32_t> next(kRounds * kPlaces, 0);
  for (const auto& [depth, surfel] : order)
    for (int round = 0; round < kRounds; ++round) ++next[round * kPlaces + digit(depth, round)];
  std::vector<std::pair<float, int32_t>> other(order.size());
  for (int round = 0; round < kRounds; ++round, order.swap(other)) {
    uint32_t* to = next.data() + round * kPlaces;
    std::exclusive_scan(to, to + kPlaces, to, uint32_t(0));
    for (const auto& pair : order) other[to[digit(pair.first, round)]++] = pair;
  }
}

template <class S>
using Order = std::pair<S, int32_t>;  // depth, surfel

// The extents and level sets of surfels in an order, asked for one after the other.
template <class Kernel, class S>
class Extents {
 public:
  Extents(const View<S>& view, const Order<S>* order, int64_t begin, int64_t end, float* level)
      : geom_(view.geom),
        near_(view.near),
        sharp_(double(Resize<S>(view.photo_pixel).sharp)),
        order_(order),
        next_(begin),
        end_(end),
        level_(level) {}
  const Extent& of(int64_t k) {
    if (k >= next_) look(k);
    return found_[k - first_];
  }

 private:
  using P = Pack<float>;

  void look(int64_t k) {
    first_ = k, next_ = std::min(k + kLanes, end_);
    if constexpr (std::is_same_v<S, float> && !Kernel::kPixel)
      look_at_pack();
    else
      for (int lane = 0; lane < next_ - first_; ++lane) {
        const S* g = row(lane);
        found_[lane] = extent<Kernel>(g, sharp_);
        if (filtered<Kernel>(g)) continue;  // has no level set of its own
        double wide[kGeom];
        for (int c = 0; c < kGeom; ++c) wide[c] = double(g[c]);
        const Level<double> l = level_of<Kernel>(wide, sharp_, kFloatRoom);
        const bool covered = covers_low_pass(wide, double(near_), 1 / sharp_);
        note(lane, float(l.r2), covered ? 0.0f : float(l.blur));
      }
  }
  void look_at_pack() {
    float columns[kGeom][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const S* g = row(lane);
      for (int c = 0; c < kGeom; ++c) columns[c][lane] = g[c];
    }
    P g[kGeom];
    for (int c = 0; c < kGeom; ++c) g[c] = load(columns[c]);
    auto [level, e] = pack_extent<Kernel>(g, sharp_);
    find_outermost(e);
    const P blur = select(covers_low_pass(g, P(near_), P(1 / sharp_)), P(0.0f), level.blur);
    const uint32_t whole = bits(e.whole), ellipse = bits(e.ellipse), thin = bits(e.thin);
    for (int lane = 0; lane < next_ - first_; ++lane) {
      Extent& to = found_[lane];
      to.visible = true;
      to.whole = whole >> lane & 1, to.ellipse = ellipse >> lane & 1, to.thin = thin >> lane & 1;
      to.x0 = e.x0[lane], to.x1 = e.x1[lane], to.y0 = e.y0[lane], to.y1 = e.y1[lane];
      to.y_left = e.y_left[lane], to.y_right = e.y_right[lane], to.blur = e.blur[lane];
      to.qa = e.qa[lane], to.qb = e.qb[lane], to.qc = e.qc[lane];
      to.qd = e.qd[lane], to.qe = e.qe[lane], to.qf = e.qf[lane];
      note(lane, level.r2[lane], blur[lane]);
    }
  }
  const S* row(int lane) const { return geom_ + int64_t(order_[std::min(first_ + lane, end_ - 1)].second) * kGeom; }
  void note(int lane, float r2, float blur) {
    float* to = level_ + 2 * int64_t(order_[first_ + lane].second);
    to[0] = r2, to[1] = blur * blur;
  }

  const S *geom_, near_;
  double sharp_;
  const Order<S>* order_;
  int64_t first_ = 0, next_, end_;
  float* level_;
  Extent found_[kLanes];
};

// fn(tile) for every tile that a disc may touch which comes near the camera's plane and has no box.
template <class S, class F>
void for_reached_tiles(const S* g, const float* level, const Bins& bins, F&& fn) {
  using P = Pack<S>;
  constexpr S kHalf = S(0.5 * (kTile - 1));
  const S half_x = cell_half(kHalf, g[kCx], S(bins.tiles_x * kTile));
  const S half_y = cell_half(kHalf, g[kCy], S(bins.tiles_y * kTile));
  P column;
  for (int lane = 0; lane < kLanes; ++lane) column.set(lane, S(lane * kTile) + S(0.5 * kTile) - g[kCx]);
  for (int row = 0; row < bins.tiles_y; ++row)
    for (int first = 0; first < bins.tiles_x; first += kLanes) {
      const P y = P(S(row * kTile) + S(0.5 * kTile) - g[kCy]);
      const Reached r = reached_cells(g, column + P(S(first * kTile)), y, half_x, half_y, level);
      const int there = std::min(kLanes, bins.tiles_x - first);
      for (uint32_t some = (r.support | r.centre) & ((1u << there) - 1); some; some &= some - 1)
        fn(row * bins.tiles_x + first + __builtin_ctz(some));
    }
}

template <class Kernel, class S>
void bin(const View<S>& view, Bins& bins) {
  const S *geom = view.geom, *radii = view.radii;
  const int64_t n = view.n;
  const int width = view.width, height = view.height;
  bins.tiles_x = tiles_across(width), bins.tiles_y = tiles_across(height);
  const int64_t tiles = int64_t(bins.tiles_x) * bins.tiles_y;
  bins.level.resize(2 * n);
  // front to back once for all tiles; equal depths keep their order
  std::vector<Order<S>> order;
  order.reserve(n);
  for (int64_t i = 0; i < n; ++i)
    if (radii[2 * i] > S(0)) order.emplace_back(geom[i * kGeom + kZ], int32_t(i));
  sort_by_depth(order);
  // each thread counts and later fills its own run of the order: the lists come out sorted
  const int64_t visible = int64_t(order.size());
  const int parts = std::max(1, int(std::min<int64_t>(num_threads(), visible / 512)));
  std::vector<std::vector<int32_t>> touched(parts);
  std::vector<std::vector<int64_t>> at(parts, std::vector<int64_t>(tiles, 0));
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) {
    std::vector<int32_t>& list = touched[t];
    list.reserve(8 * (visible / parts + 1));
    const int64_t end = visible * (t + 1) / parts;
    Extents<Kernel, S> extents(view, order.data(), visible * t / parts, end, bins.level.data());
    for (int64_t k = visible * t / parts; k < end; ++k) {
      const Extent& e = extents.of(k);
      const size_t head = list.size();
      list.push_back(0);
      const int only = only_tile(geom + int64_t(order[k].second) * kGeom, radii + 2 * int64_t(order[k].second), bins);
      if (only >= 0) {
        list.push_back(only), list[head] = 1;
        ++at[t][only];
        continue;
      }
      const auto touch = [&](int tile) {
        list.push_back(tile);
        ++at[t][tile];
      };
      const int64_t id = order[k].second;
      if (e.whole && !filtered<Kernel>(geom + id * kGeom))
        for_reached_tiles(geom + id * kGeom, bins.level.data() + 2 * id, bins, touch);
      else
        for_tile_rows(e, geom + id * kGeom, width, height, [&](int row, int first, int last) {
          for (int tile = row * bins.tiles_x + first; tile <= row * bins.tiles_x + last; ++tile) touch(tile);
        });
      list[head] = int32_t(list.size() - head - 1);
    }
  }
  bins.start.assign(tiles + 1, 0);
  for (int64_t tile = 0; tile < tiles; ++tile) {
    int64_t next = bins.start[tile];
    for (int t = 0; t < parts; ++t) {
      const int64_t count = at[t][tile];
      at[t][tile] = next;
      next += count;
    }
    bins.start[tile + 1] = next;
  }
  bins.surfels.resize(bins.start[tiles]);
#pragma omp parallel for num_threads(parts) schedule(static, 1)
  for (int t = 0; t < parts; ++t) {
    const int32_t* p = touched[t].data();
    for (int64_t k = visible * t / parts; k < visible * (t + 1) / parts; ++k) {
      const int32_t count = *p++;
      for (int32_t j = 0; j < count; ++j) bins.surfels[at[t][*p++]++] = order[k].second;
    }
  }
}
}  // namespace

template <class S>
void bin(const View<S>& view, Bins& bins) {
  with_kernel(view.through_pixel, float(view.photo_pixel), [&](auto kernel) { bin<decltype(kernel)>(view, bins); });
}

template void bin(const View<float>&, Bins&);
template void bin(const View<double>&, Bins&);

}  // namespace bt
