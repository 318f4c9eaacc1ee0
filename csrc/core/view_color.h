// View-dependent colours f_view(d) of all surfels: parameter arrays, and dispatch to a kind of core/view_kinds.h.
#pragma once

#include "core/view_kinds.h"

namespace bt {

// Computes the vector from the camera's centre in double: far from the origin, a rounded centre would turn it.
template <class S> BT_HD Vec3<S> from_center(const S* mean, const double* center) {
  return {S(double(mean[0]) - center[0]), S(double(mean[1]) - center[1]), S(double(mean[2]) - center[2])};
}
template <class S> BT_HD Unit<S> view_direction(const S* mean, const double* center) {
  return normalize(from_center(mean, center));
}

// Call f with the struct of a kind, an index into the names of ViewColorKinds, and return its result.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable  // f may be for host or device only
#endif
template <class F, class Kind, class... Rest> BT_HD auto for_kind(int kind, F&& f, ViewColorList<Kind, Rest...>) {
  if constexpr (sizeof...(Rest) > 0)
    if (kind > 0) return for_kind(kind - 1, f, ViewColorList<Rest...>());
  return f(Kind());
}
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class F> BT_HD auto for_view_color(int kind, F&& f) { return for_kind(kind, f, ViewColorKinds()); }
BT_HD ViewColorWidths view_color_widths(int kind, int K) {
  return for_view_color(kind, [=](auto view_color) { return view_color.widths(K); });
}

// Parameters of n surfels: a, b and c are [n, width] (view_color_widths). `terms`: sites, coefficients or lobes.
template <class S> struct ViewColorArrays {
  int kind, terms;
  S *a, *b, *c;

  template <class R>  // as in ops/arguments.h
  void fields(R& r, int64_t n) {
    r.choice("kind", kind, ViewColorKinds::kNames);
    r.number("terms", terms);
    arrays(r, n, "a", "b", "c");
  }
  template <class R> void arrays(R& r, int64_t n, const char* name_a, const char* name_b, const char* name_c) {
    const int least = for_view_color(kind, [](auto view_color) { return view_color.kLeastTerms; });
    if (terms < least || terms > kMaxTerms) r.refuse("a view colour has 1 to 32 terms, of sb and sg 0 to 32");
    const ViewColorWidths w = view_color_widths(kind, terms);
    r.array(name_a, a, w.a * n);
    r.array(name_b, b, w.b * n);
    if (w.c) r.array(name_c, c, w.c * n);
  }
  BT_HD ViewColorRow<S> row(ViewColorWidths w, int64_t i) const { return {a + w.a * i, b + w.b * i, c + w.c * i}; }
};
// Evaluates the colour of surfel i. K is p.terms; kernels that know it at compile time unroll their loops.
template <class ViewColor, class S>
BT_HD Vec3<S> view_color(int K, const ViewColorArrays<const S>& p, int64_t i, Vec3<S> d) {
  return ViewColor::color(K, p.row(ViewColor::widths(K), i), d);
}
// Writes the gradients of the parameters of surfel i and returns that of d.
template <class ViewColor, class S>
BT_HD Vec3<S> view_color_vjp(int K, const ViewColorArrays<const S>& p, int64_t i, Vec3<S> d, Vec3<S> dc,
                             const ViewColorArrays<S>& dp) {
  const ViewColorWidths w = ViewColor::widths(K);
  Vec3<S> dd = {S(0), S(0), S(0)};
  ViewColor::color_vjp(K, p.row(w, i), d, dc, dp.row(w, i), dd);
  return dd;
}
BT_HD int reduced_width(int kind) {
  return for_view_color(kind, [](auto view_color) { return view_color.kReducedWidth; });
}
// Reduced view colours: a base colour and a varying number of terms per surfel.
template <class S> struct ReducedColors {
  int kind;
  const S *base, *terms;  // [n, 3], [all terms, reduced_width(kind)]
  const int32_t* span;    // [n, 2]: first term, number of terms

  template <class R> void fields(R& r, int64_t n, int64_t& count) {
    r.choice("kind", kind, ViewColorKinds::kNames);
    r.array("base", base, 3 * n);
    r.array("span", span, 2 * n);
    r.rows("reduced", terms, count, reduced_width(kind));
  }
};
template <class S> BT_HD Vec3<S> view_color(const ReducedColors<S>& p, int64_t i, Vec3<S> d) {
  return for_view_color(p.kind, [&](auto view_color) {
    constexpr int kWidth = decltype(view_color)::kReducedWidth;
    return view_color.reduced_color(p.span[2 * i + 1], p.base + 3 * i, p.terms + int64_t(p.span[2 * i]) * kWidth, d);
  });
}
// View colours of n surfels: whole, or reduced if reduced.base is not null.
template <class S> struct ViewColors {
  ViewColorArrays<const S> whole;
  ReducedColors<S> reduced;
  int64_t reduced_terms;  // of all surfels

  template <class R> void fields(R& r, int64_t n) {
    if (r.has("reduced"))
      reduced.fields(r, n, reduced_terms);
    else
      whole.fields(r, n);
  }
};

}  // namespace bt
