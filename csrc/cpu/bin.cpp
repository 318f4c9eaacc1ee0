// Tile lists: the surfels that may touch each tile, front to back.
#include <cstring>
#include <numeric>

#include "core/resize.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"
#include "cpu/tile_state.h"

namespace bt {

namespace {
// Returns the tile that contains the box of a surfel, whose rows are then not intersected; -1: several tiles.
template <class S> int only_tile(const S* g, const S* radii, const Bins& bins) {
  const S x = g[kCx] - S(0.5), y = g[kCy] - S(0.5), side = S(kTile);
  const S column = floor_((x - radii[0]) / side), row = floor_((y - radii[1]) / side);
  if (!(column >= S(0) && row >= S(0) && column < S(bins.tiles_x) && row < S(bins.tiles_y))) return -1;
  if (!(x + radii[0] < (column + S(1)) * side - S(1) && y + radii[1] < (row + S(1)) * side - S(1))) return -1;
  return int(row) * bins.tiles_x + int(column);
}

// Arguments of `reached` (core/kernel.h) for a row: r_c^2, and the squared radius of the low pass, 0 if covered.
struct ReachLevels {
  float r2, blur2;
};
template <class Kernel, class S> BT_HD ReachLevels reach_levels(const S* geom, S near, double sharp) {
  double g[kGeom];
  for (int c = 0; c < kGeom; ++c) g[c] = double(geom[c]);
  const Level<double> l = level_of<Kernel>(g, sharp, kFloatRoom);
  const float blur = covers_low_pass(g, double(near), 1 / sharp) ? 0.0f : float(l.blur);
  return {float(l.r2), blur * blur};
}

template <class S> void sort_by_depth(std::vector<std::pair<S, int32_t>>& order) {
  std::sort(order.begin(), order.end());
}
// Radix-sorts depths in front of the camera by their bits, in three rounds of eleven.
void sort_by_depth(std::vector<std::pair<float, int32_t>>& order) {
  constexpr int kBits = 11, kBuckets = 1 << kBits, kRounds = 3;
  const auto digit = [](float depth, int round) {
    uint32_t bits;
    std::memcpy(&bits, &depth, sizeof bits);
    return bits >> kBits * round & (kBuckets - 1);
  };
  std::vector<uint32_t> next(kRounds * kBuckets, 0);
  for (const auto& [depth, surfel] : order)
    for (int round = 0; round < kRounds; ++round) ++next[round * kBuckets + digit(depth, round)];
  std::vector<std::pair<float, int32_t>> other(order.size());
  for (int round = 0; round < kRounds; ++round, order.swap(other)) {
    uint32_t* to = next.data() + round * kBuckets;
    std::exclusive_scan(to, to + kBuckets, to, uint32_t(0));
    for (const auto& pair : order) other[to[digit(pair.first, round)]++] = pair;
  }
}

template <class S> using Order = std::pair<S, int32_t>;  // depth, surfel

// Extents and level sets of surfels, sixteen at a time.
template <class Kernel, class S> class Extents {
 public:
  Extents(const View<S>& view, const Order<S>* order, int64_t begin, int64_t end, float* level)
      : view_(view),
        sharp_(double(Resize<S>(view.photo_pixel).sharp)),
        order_(order),
        next_(begin),
        end_(end),
        level_(level) {}
  const Extent& of(int64_t k) {
    if (k >= next_) load(k);
    return found_[k - first_];
  }

 private:
  using P = Lanes<float>;

  void load(int64_t k) {
    first_ = k, next_ = std::min(k + kLanes, end_);
    for (int64_t after = next_; after < std::min(next_ + kLanes, end_); ++after) {
      __builtin_prefetch(view_.geom + int64_t(order_[after].second) * kGeom);
      __builtin_prefetch(view_.radii + 2 * int64_t(order_[after].second));
    }
    if constexpr (std::is_same_v<S, float>)
      load_lanes();
    else
      for (int lane = 0; lane < next_ - first_; ++lane) {
        const S* g = row(lane);
        found_[lane] = extent<Kernel>(g, view_.width, view_.height, sharp_);
        store_levels(lane, reach_levels<Kernel>(g, view_.near, sharp_));
      }
  }
  void load_lanes() {
    float columns[kGeom][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const S* g = row(lane);
      for (int c = 0; c < kGeom; ++c) columns[c][lane] = g[c];
    }
    P g[kGeom];
    for (int c = 0; c < kGeom; ++c) g[c] = bt::load(columns[c]);
    auto [level, e] = level_extent<Kernel>(g, view_.width, view_.height, sharp_, kFloatRoom);
    find_outermost(e);
    const P blur = select(covers_low_pass(g, P(view_.near), P(1 / sharp_)), P(0.0f), level.blur);
    const uint32_t whole = bits(e.whole), ellipse = bits(e.ellipse), thin = bits(e.thin);
    for (int lane = 0; lane < next_ - first_; ++lane) {
      Extent& to = found_[lane];
      to.visible = true;
      to.whole = whole >> lane & 1, to.ellipse = ellipse >> lane & 1, to.thin = thin >> lane & 1;
      each_number(to, e, [lane](double& one, const Lanes<double>& all) { one = all[lane]; });
      store_levels(lane, {level.r2[lane], blur[lane] * blur[lane]});
    }
  }
  const S* row(int lane) const {
    return view_.geom + int64_t(order_[std::min(first_ + lane, end_ - 1)].second) * kGeom;
  }
  void store_levels(int lane, ReachLevels levels) {
    float* to = level_ + 2 * int64_t(order_[first_ + lane].second);
    to[0] = levels.r2, to[1] = levels.blur2;
  }

  const View<S>& view_;
  double sharp_;
  const Order<S>* order_;
  int64_t first_ = 0, next_, end_;
  float* level_;
  Extent found_[kLanes];
};

// Tile spans of surfels, sixteen rows at a time.
class TileRows {
 public:
  explicit TileRows(int width) : width_(width) {}
  // Adds the rows of a surfel; calls put(k, row, first, last) when the lanes are full, in surfel order.
  template <class S, class Put> void add(int64_t k, const Extent& e, const S* g, int height, Put&& put) {
    const TileSpan<double> rows = tile_rows(e, g, height);
    for (int row = int(rows.first); row <= int(rows.last); ++row) {
      each_number(extents_, e, [this](P& all, double one) { all.set(count_, one); });
      whole_ |= uint32_t(e.whole) << count_, ellipse_ |= uint32_t(e.ellipse) << count_;
      thin_ |= uint32_t(e.thin) << count_;
      cx_.set(count_, double(g[kCx])), cy_.set(count_, double(g[kCy])), row_.set(count_, double(row)), k_[count_] = k;
      if (++count_ == kLanes) finish(put);
    }
  }
  template <class Put> void finish(Put&& put) {
    extents_.whole = mask_of<double>(whole_), extents_.ellipse = mask_of<double>(ellipse_);
    extents_.thin = mask_of<double>(thin_);
    const TileSpan<P> span = tile_columns(extents_, cx_, cy_, row_, width_);
    for (int lane = 0; lane < count_; ++lane)
      put(k_[lane], int(row_[lane]), int(span.first[lane]), int(span.last[lane]));
    count_ = 0, whole_ = ellipse_ = thin_ = 0;
  }

 private:
  using P = Lanes<double>;
  ExtentOf<P> extents_;
  uint32_t whole_ = 0, ellipse_ = 0, thin_ = 0;  // flags of the extents, by lane
  P cx_ = P(0.0), cy_ = P(0.0), row_ = P(0.0);
  int64_t k_[kLanes];
  int width_, count_ = 0;
};

// Calls fn(tile) for every tile that may be touched by a disc near the camera's plane without a box.
template <class S, class F> void for_reached_tiles(const S* g, const float* level, const Bins& bins, F&& fn) {
  using P = Lanes<S>;
  constexpr S kHalf = S(0.5 * (kTile - 1));
  const S half_x = cell_half(kHalf, g[kCx], S(bins.tiles_x * kTile));
  const S half_y = cell_half(kHalf, g[kCy], S(bins.tiles_y * kTile));
  P column;
  for (int lane = 0; lane < kLanes; ++lane) column.set(lane, S(lane * kTile) + S(0.5 * kTile) - g[kCx]);
  for (int row = 0; row < bins.tiles_y; ++row)
    for (int first = 0; first < bins.tiles_x; first += kLanes) {
      const P y = P(S(row * kTile) + S(0.5 * kTile) - g[kCy]);
      const ReachedCells r = reached_cells(g, column + P(S(first * kTile)), y, half_x, half_y, level);
      const int there = std::min(kLanes, bins.tiles_x - first);
      for (uint32_t some = (r.support | r.centre) & ((1u << there) - 1); some; some &= some - 1)
        fn(row * bins.tiles_x + first + __builtin_ctz(some));
    }
}

// Each thread counts and later fills its own run of the order, so lists come out sorted.
template <class Kernel, class S> class KernelBinner final : public Binner<S> {
 public:
  KernelBinner(const View<S>& view, Bins& bins) : view_(view), bins_(bins) {
    bins.tiles_x = tiles_across(view.width), bins.tiles_y = tiles_across(view.height);
    bins.level.resize(2 * view.n);
    order_.resize(view.n), visible_.resize((view.n + kChunk - 1) / kChunk);
  }

  void run(const Member& m, const typename Binner<S>::Aside& aside) override {
    m.each(view_.n, kChunk, [&](int64_t begin, int64_t end) { gather(begin, end); });
    m.meet();
    if (m.index == 0) sort(m.size);
    if (aside) m.each(view_.n, kChunk, aside);
    m.meet();
    count(m.index);
    m.meet();
    if (m.index == 0) scan();
    m.meet();
    fill(m.index);
    m.meet();
  }

 private:
  static constexpr int64_t kChunk = 1024;
  // Adjacent tiles in a row that surfel k of the order may touch.
  struct Span {
    int32_t k, tile, count;
  };
  struct Touched {
    std::vector<Span> alone, others;  // of surfels with one tile, and of others, in order
  };

  void gather(int64_t begin, int64_t end) {
    Order<S>* to = order_.data() + begin;
    for (int64_t i = begin; i < end; ++i)
      if (view_.radii[2 * i] > S(0)) *to++ = {view_.geom[i * kGeom + kZ], int32_t(i)};
    visible_[begin / kChunk] = to - (order_.data() + begin);
  }

  // Sorts front to back once for all tiles, stably.
  void sort(int parts) {
    auto end = order_.begin();
    for (size_t c = 0; c < visible_.size(); ++c) {
      const auto from = order_.begin() + int64_t(c) * kChunk;
      end = std::move(from, from + visible_[c], end);
    }
    order_.erase(end, order_.end());
    sort_by_depth(order_);
    touched_.resize(parts);
    at_.resize(parts);
  }

  int64_t run_begin(int part) const { return int64_t(order_.size()) * part / int64_t(at_.size()); }
  int64_t tiles() const { return int64_t(bins_.tiles_x) * bins_.tiles_y; }

  void count(int part) {
    const int64_t begin = run_begin(part), end = run_begin(part + 1);
    Touched& to = touched_[part];
    std::vector<int64_t>& at = at_[part];
    at.assign(tiles(), 0);
    to.alone.reserve(end - begin), to.others.reserve(4 * (end - begin));
    Extents<Kernel, S> extents(view_, order_.data(), begin, end, bins_.level.data());
    TileRows rows(view_.width);
    const auto add = [&](std::vector<Span>& list, int64_t k, int tile, int count) {
      list.push_back({int32_t(k), tile, count});
      for (int i = 0; i < count; ++i) ++at[tile + i];
    };
    const auto add_row = [&](int64_t k, int row, int first, int last) {
      if (first <= last) add(to.others, k, row * bins_.tiles_x + first, last - first + 1);
    };
    for (int64_t k = begin; k < end; ++k) {
      const Extent& e = extents.of(k);
      const int64_t id = order_[k].second;
      const S* g = view_.geom + id * kGeom;
      if (const int only = only_tile(g, view_.radii + 2 * id, bins_); only >= 0) {
        add(to.alone, k, only, 1);
      } else if (e.whole) {
        rows.finish(add_row);  // earlier surfels first
        for_reached_tiles(g, bins_.level.data() + 2 * id, bins_, [&](int tile) { add(to.others, k, tile, 1); });
      } else {
        rows.add(k, e, g, view_.height, add_row);
      }
    }
    rows.finish(add_row);
  }

  // Converts counts per tile and run to offsets.
  void scan() {
    bins_.start.assign(tiles() + 1, 0);
    for (int64_t tile = 0; tile < tiles(); ++tile) {
      int64_t next = bins_.start[tile];
      for (std::vector<int64_t>& at : at_) {
        const int64_t count = at[tile];
        at[tile] = next;
        next += count;
      }
      bins_.start[tile + 1] = next;
    }
    bins_.surfels.resize(bins_.start.back());
  }

  void fill(int part) {
    std::vector<int64_t>& at = at_[part];
    const auto put = [&](const Span& span) {
      for (int i = 0; i < span.count; ++i) bins_.surfels[at[span.tile + i]++] = order_[span.k].second;
    };
    const Touched& from = touched_[part];
    auto other = from.others.begin();
    for (const Span& alone : from.alone) {
      for (; other != from.others.end() && other->k < alone.k; ++other) put(*other);
      put(alone);
    }
    std::for_each(other, from.others.end(), put);
  }

  const View<S> view_;
  Bins& bins_;
  std::vector<Order<S>> order_;           // visible surfels, once sorted
  std::vector<int64_t> visible_;          // per chunk
  std::vector<Touched> touched_;          // per run
  std::vector<std::vector<int64_t>> at_;  // per run and tile: count, then next offset
};
}  // namespace

template <class S> std::unique_ptr<Binner<S>> binner(const View<S>& view, Bins& bins) {
  std::unique_ptr<Binner<S>> made;
  with_kernel(float(view.photo_pixel),
              [&](auto kernel) { made = std::make_unique<KernelBinner<decltype(kernel), S>>(view, bins); });
  return made;
}

template std::unique_ptr<Binner<float>> binner(const View<float>&, Bins&);
template std::unique_ptr<Binner<double>> binner(const View<double>&, Bins&);

}  // namespace bt
