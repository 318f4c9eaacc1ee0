// View colours of all surfels.
#include "core/view_color.h"

#include <stdexcept>
#include <string>

#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
template <class S> void check_terms(const ViewColors<S>& colors, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const int64_t first = colors.lean.span[2 * i], count = colors.lean.span[2 * i + 1];
    if (first < 0 || count < 0 || count > kMaxTerms || first + count > colors.lean_terms)
      throw std::invalid_argument("the terms of surfel " + std::to_string(i) + "'s view colour are not there");
  }
}
}  // namespace

template <class S> void view_color_forward(const ViewColorForward<S>& a) {
  const auto write = [&](auto&& color) {  // color(i, direction)
    parallel_parts(a.to.n, 256, [&](int, int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        Vec3<S> c = {S(0), S(0), S(0)};
        if (a.to.active[i]) c = color(i, view_direction(a.to.means + 3 * i, a.to.center).n);
        store3(a.out + 3 * i, c);
      }
    });
  };
  if (a.colors.lean.base) {
    check_terms(a.colors, a.to.n);
    return write([&](int64_t i, Vec3<S> d) { return view_color(a.colors.lean, i, d); });
  }
  const ViewColorArrays<const S>& p = a.colors.whole;
  for_view_color(p.kind, [&](auto kind) {
    write([&](int64_t i, Vec3<S> d) { return view_color<decltype(kind)>(p.terms, p, i, d); });
  });
}

template <class S> void view_color_backward(const ViewColorBackward<S>& a) {
  const ViewColorArrays<const S>& p = a.colors;
  const ViewColorArrays<S>& dp = a.dcolors;
  for_view_color(p.kind, [&](auto kind) {
    const ViewColorWidths w = kind.widths(p.terms);
    parallel_parts(a.to.n, 256, [&](int, int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        if (!a.to.active[i]) {
          const ViewColorRow<S> none = dp.row(w, i);
          std::fill(none.a, none.a + w.a, S(0));
          std::fill(none.b, none.b + w.b, S(0));
          std::fill(none.c, none.c + w.c, S(0));
          store3(a.dmeans + 3 * i, Vec3<S>{S(0), S(0), S(0)});
          continue;
        }
        const Unit<S> d = view_direction(a.to.means + 3 * i, a.to.center);
        const Vec3<S> dd = view_color_vjp<decltype(kind)>(p.terms, p, i, d.n, load3(a.dout + 3 * i), dp);
        store3(a.dmeans + 3 * i, normalize_vjp(d, dd));
      }
    });
  });
}

#define BT_INSTANTIATE(S)                                       \
  template void view_color_forward(const ViewColorForward<S>&); \
  template void view_color_backward(const ViewColorBackward<S>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
