// View colours of all surfels.
#include "core/view_color.h"

#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

template <class S>
void view_color_forward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                        const uint8_t* active, S* out) {
  parallel_parts(n, 256, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      Vec3<S> c = {S(0), S(0), S(0)};
      if (active[i]) c = view_color(p.kind, p.terms, p, i, view_direction(means + 3 * i, center).n);
      store3(out + 3 * i, c);
    }
  });
}

template <class S>
void lean_color(int64_t n, const LeanColors<S>& p, const S* means, const double* center, const uint8_t* active,
                S* out) {
  parallel_parts(n, 256, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      Vec3<S> c = {S(0), S(0), S(0)};
      if (active[i]) c = view_color(p, i, view_direction(means + 3 * i, center).n);
      store3(out + 3 * i, c);
    }
  });
}

template <class S>
void view_color_backward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                         const uint8_t* active, const S* dout, const ViewColorArrays<S>& dp, S* dmeans) {
  const auto [na, nb, nc] = view_color_widths(p.kind, p.terms);
  parallel_parts(n, 256, [&, na = na, nb = nb, nc = nc](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      if (!active[i]) {
        std::fill(dp.a + na * i, dp.a + na * (i + 1), S(0));
        std::fill(dp.b + nb * i, dp.b + nb * (i + 1), S(0));
        if (nc) std::fill(dp.c + nc * i, dp.c + nc * (i + 1), S(0));
        store3(dmeans + 3 * i, Vec3<S>{S(0), S(0), S(0)});
        continue;
      }
      const Unit<S> d = view_direction(means + 3 * i, center);
      const Vec3<S> dd = view_color_vjp(p.kind, p.terms, p, i, d.n, load3(dout + 3 * i), dp);
      store3(dmeans + 3 * i, normalize_vjp(d, dd));
    }
  });
}

#define BT_INSTANTIATE(S)                                                                                  \
  template void view_color_forward<S>(int64_t, const ViewColorArrays<const S>&, const S*, const double*,   \
                                      const uint8_t*, S*);                                                 \
  template void lean_color<S>(int64_t, const LeanColors<S>&, const S*, const double*, const uint8_t*, S*); \
  template void view_color_backward<S>(int64_t, const ViewColorArrays<const S>&, const S*, const double*,  \
                                       const uint8_t*, const S*, const ViewColorArrays<S>&, S*);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
