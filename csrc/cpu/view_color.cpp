// View colours of all surfels.
#include "core/view_color.h"

#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
enum Kind { kSv, kSh, kSb, kSg };
}  // namespace

template <class S>
void view_color_forward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                        const uint8_t* active, S* out) {
  const int K = p.terms;
  parallel_parts(n, 256, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      Vec3<S> c = {S(0), S(0), S(0)};
      if (active[i]) {
        const Vec3<S> d = view_direction(means + 3 * i, center).n;
        if (p.kind == kSv) c = sv_color(K, p.a + 3 * K * i, p.b + K * i, p.c + 3 * K * i, d);
        if (p.kind == kSh) c = sh_color(K, p.a + 3 * i, p.b + 3 * (K - 1) * i, d);
        if (p.kind == kSb) c = sb_color(K, p.a + 3 * i, p.b + 6 * K * i, d);
        if (p.kind == kSg) c = sg_color(K, p.a + 3 * i, p.b + 7 * K * i, d);
      }
      store3(out + 3 * i, c);
    }
  });
}

template <class S>
void view_color_backward(int64_t n, const ViewColorArrays<const S>& p, const S* means, const double* center,
                         const uint8_t* active, const S* dout, const ViewColorArrays<S>& dp, S* dmeans) {
  const int K = p.terms;
  const int64_t na = p.kind == kSv ? 3 * K : 3;
  const int64_t nb = p.kind == kSv ? K : p.kind == kSh ? 3 * (K - 1) : (p.kind == kSb ? 6 : 7) * K;
  const int64_t nc = p.kind == kSv ? 3 * K : 0;
  parallel_parts(n, 256, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      if (!active[i]) {
        std::fill(dp.a + na * i, dp.a + na * (i + 1), S(0));
        std::fill(dp.b + nb * i, dp.b + nb * (i + 1), S(0));
        if (nc) std::fill(dp.c + nc * i, dp.c + nc * (i + 1), S(0));
        store3(dmeans + 3 * i, Vec3<S>{S(0), S(0), S(0)});
        continue;
      }
      const Unit<S> d = view_direction(means + 3 * i, center);
      const Vec3<S> g = load3(dout + 3 * i);
      Vec3<S> dd = {S(0), S(0), S(0)};
      if (p.kind == kSv)
        sv_color_vjp(K, p.a + na * i, p.b + nb * i, p.c + nc * i, d.n, g, dp.a + na * i, dp.b + nb * i, dp.c + nc * i,
                     dd);
      if (p.kind == kSh) sh_color_vjp(K, p.b + nb * i, d.n, g, dp.a + na * i, dp.b + nb * i, dd);
      if (p.kind == kSb) sb_color_vjp(K, p.b + nb * i, d.n, g, dp.a + na * i, dp.b + nb * i, dd);
      if (p.kind == kSg) sg_color_vjp(K, p.b + nb * i, d.n, g, dp.a + na * i, dp.b + nb * i, dd);
      store3(dmeans + 3 * i, normalize_vjp(d, dd));
    }
  });
}

#define BT_INSTANTIATE(S)                                                                                 \
  template void view_color_forward<S>(int64_t, const ViewColorArrays<const S>&, const S*, const double*,  \
                                      const uint8_t*, S*);                                                \
  template void view_color_backward<S>(int64_t, const ViewColorArrays<const S>&, const S*, const double*, \
                                       const uint8_t*, const S*, const ViewColorArrays<S>&, S*);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
