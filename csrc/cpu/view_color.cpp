// View colours of surfels, and corrections of photographs.
#include "core/view_color.h"

#include <algorithm>
#include <stdexcept>
#include <string>

#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace bt {

namespace {
template <class S> void check_terms(const ViewColors<S>& colors, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const int64_t first = colors.reduced.span[2 * i], count = colors.reduced.span[2 * i + 1];
    if (first < 0 || count < 0 || count > kMaxTerms || first + count > colors.reduced_terms)
      throw std::invalid_argument("the terms of surfel " + std::to_string(i) + "'s view colour are not there");
  }
}

// Kinds evaluated for 16 surfels at a time.
template <class Kind, class S>
constexpr bool kTogether = std::is_same_v<Kind, SphericalVoronoi> && std::is_same_v<S, float>;

using P = Lanes<float>;
// Up to 16 active surfels; lanes from `count` on repeat the last one.
struct Together {
  int64_t ids[kLanes];
  int count = 0;

  // Loads the surfels' rows of `width` numbers, a surfel per lane; stores those of the first `count` lanes.
  void load_rows(const float* from, int64_t width, P* to) const {
    for (int lane = 0; lane < kLanes; ++lane)
      for (int64_t k = 0; k < width; ++k) to[k].set(lane, from[ids[lane] * width + k]);
  }
  void store_rows(const P* from, int64_t width, float* to) const {
    for (int lane = 0; lane < count; ++lane)
      for (int64_t k = 0; k < width; ++k) to[ids[lane] * width + k] = from[k][lane];
  }
  Unit<P> directions(const Directions<float>& to) const {
    P along[3];
    for (int lane = 0; lane < kLanes; ++lane) {
      const Vec3<float> d = from_center(to.means + 3 * ids[lane], to.center);
      along[0].set(lane, d.x), along[1].set(lane, d.y), along[2].set(lane, d.z);
    }
    return normalize(load3(along));
  }
};
// Calls fn(Together) for the active surfels of begin to end - 1.
template <class F> void each_together(const uint8_t* active, int64_t begin, int64_t end, F&& fn) {
  Together some;
  for (int64_t i = begin; i < end; ++i) {
    if (active[i]) some.ids[some.count++] = i;
    if (some.count < kLanes && (some.count == 0 || i + 1 < end)) continue;
    std::fill(some.ids + some.count, some.ids + kLanes, some.ids[some.count - 1]);
    fn(some);
    some.count = 0;
  }
}
// Parameters of several surfels, or their gradients.
struct TogetherRow {
  P a[3 * kMaxTerms], b[kMaxTerms], c[3 * kMaxTerms];
};
}  // namespace

template <class S> void view_color_forward(const ViewColorForward<S>& a) {
  const auto write = [&](auto&& color) {  // color(i, direction)
    parallel_each(a.to.n, 256, [&](int64_t i) {
      Vec3<S> c = {S(0), S(0), S(0)};
      if (a.to.active[i]) c = color(i, view_direction(a.to.means + 3 * i, a.to.center).n);
      store3(a.out + 3 * i, c);
    });
  };
  if (a.colors.reduced.base) {
    check_terms(a.colors, a.to.n);
    return write([&](int64_t i, Vec3<S> d) { return view_color(a.colors.reduced, i, d); });
  }
  const ViewColorArrays<const S>& p = a.colors.whole;
  for_view_color(p.kind, [&](auto kind) {
    using Kind = decltype(kind);
    if constexpr (kTogether<Kind, S>) {
      const ViewColorWidths w = kind.widths(p.terms);
      parallel_parts(a.to.n, 256, [&](int, int64_t begin, int64_t end) {
        TogetherRow own;
        std::fill(a.out + 3 * begin, a.out + 3 * end, S(0));
        each_together(a.to.active, begin, end, [&](const Together& some) {
          some.load_rows(p.a, w.a, own.a), some.load_rows(p.b, w.b, own.b), some.load_rows(p.c, w.c, own.c);
          P c[3];
          store3(c, kind.color(p.terms, ViewColorRow<const P>{own.a, own.b, own.c}, some.directions(a.to).n));
          some.store_rows(c, 3, a.out);
        });
      });
    } else {
      write([&](int64_t i, Vec3<S> d) { return view_color<Kind>(p.terms, p, i, d); });
    }
  });
}

template <class S> void view_color_backward(const ViewColorBackward<S>& a) {
  const ViewColorArrays<const S>& p = a.colors;
  const ViewColorArrays<S>& dp = a.dcolors;
  for_view_color(p.kind, [&](auto kind) {
    using Kind = decltype(kind);
    const ViewColorWidths w = kind.widths(p.terms);
    parallel_parts(a.to.n, 256, [&](int, int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        if (!a.to.active[i]) {
          const ViewColorRow<S> none = dp.row(w, i);
          std::fill(none.a, none.a + w.a, S(0));
          std::fill(none.b, none.b + w.b, S(0));
          std::fill(none.c, none.c + w.c, S(0));
          store3(a.dmeans + 3 * i, Vec3<S>{S(0), S(0), S(0)});
        } else if constexpr (!kTogether<Kind, S>) {
          const Unit<S> d = view_direction(a.to.means + 3 * i, a.to.center);
          const Vec3<S> dd = view_color_vjp<Kind>(p.terms, p, i, d.n, load3(a.dout + 3 * i), dp);
          store3(a.dmeans + 3 * i, normalize_vjp(d, dd));
        }
      }
      if constexpr (kTogether<Kind, S>) {
        TogetherRow own, gradients;
        each_together(a.to.active, begin, end, [&](const Together& some) {
          some.load_rows(p.a, w.a, own.a), some.load_rows(p.b, w.b, own.b), some.load_rows(p.c, w.c, own.c);
          const Unit<P> d = some.directions(a.to);
          P dc[3], dmeans[3];
          some.load_rows(a.dout, 3, dc);
          Vec3<P> dd = {P(S(0)), P(S(0)), P(S(0))};
          kind.color_vjp(p.terms, ViewColorRow<const P>{own.a, own.b, own.c}, d.n, load3(dc),
                         ViewColorRow<P>{gradients.a, gradients.b, gradients.c}, dd);
          store3(dmeans, normalize_vjp(d, dd));
          some.store_rows(gradients.a, w.a, dp.a), some.store_rows(gradients.b, w.b, dp.b);
          some.store_rows(gradients.c, w.c, dp.c), some.store_rows(dmeans, 3, a.dmeans);
        });
      }
    });
  });
}

template <class S> void learn_exposure(const LearnExposure<S>& a) {
  for (int column = 0; column < a.width; ++column) {
    a.move(column);
    if (!a.settle) continue;
    const S limit = a.limit_of(column);
    const auto entry = [&](int64_t i) -> S& { return a.table[i * a.width + column]; };
    double sum = 0;
    for (int64_t i = 0; i < a.photographs; ++i) sum += double(entry(i) = limited_entry(entry(i), limit));
    const S mean = S(sum / double(a.photographs));
    S largest = S(0);
    for (int64_t i = 0; i < a.photographs; ++i) largest = std::max(largest, abs_(entry(i) -= mean));
    const S over = std::max(largest / limit, S(1));
    for (int64_t i = 0; i < a.photographs; ++i) entry(i) /= over;
  }
}

BT_INSTANTIATE(learn_exposure, LearnExposure)
BT_INSTANTIATE(view_color_forward, ViewColorForward)
BT_INSTANTIATE(view_color_backward, ViewColorBackward)

}  // namespace bt
