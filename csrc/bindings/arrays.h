// Arrays that come from Python: dense memory of a device, sizes checked, never copied.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "core/surfel.h"

namespace bt {

namespace nb = nanobind;

// Checks the number of elements: the kernels take flat memory.
template <class T, class D>
T* data(const nb::ndarray<T, nb::c_contig, D>& a, int64_t size, const char* name) {
  if (int64_t(a.size()) != size)
    throw std::invalid_argument(std::string(name) + " has " + std::to_string(a.size()) + " elements, expected " +
                                std::to_string(size));
  return a.data();
}
// Null when it was not given; an empty array has no address, but it was given.
template <class T, class D>
T* data_or_null(const std::optional<nb::ndarray<T, nb::c_contig, D>>& a, int64_t size, const char* name) {
  static std::remove_const_t<T> nothing;
  if (!a) return nullptr;
  T* p = data(*a, size, name);
  return p ? p : &nothing;
}

// There are as many surfels as opacities.
template <class S, class D>
Surfels<S> surfels(const nb::ndarray<const S, nb::c_contig, D>& means,
                   const nb::ndarray<const S, nb::c_contig, D>& quats,
                   const nb::ndarray<const S, nb::c_contig, D>& log_scales,
                   const nb::ndarray<const S, nb::c_contig, D>& opacity_logits,
                   const nb::ndarray<const S, nb::c_contig, D>& beta_raw) {
  const int64_t n = int64_t(opacity_logits.size());
  return {n,
          data(means, 3 * n, "means"),
          data(quats, 4 * n, "quats"),
          data(log_scales, 2 * n, "log_scales"),
          opacity_logits.data(),
          data(beta_raw, n, "beta_raw")};
}
template <class S, class D>
SurfelGradients<S> surfel_gradients(int64_t n, const nb::ndarray<S, nb::c_contig, D>& means,
                                    const nb::ndarray<S, nb::c_contig, D>& quats,
                                    const nb::ndarray<S, nb::c_contig, D>& log_scales,
                                    const nb::ndarray<S, nb::c_contig, D>& opacity_logits,
                                    const nb::ndarray<S, nb::c_contig, D>& beta_raw) {
  return {data(means, 3 * n, "dmeans"), data(quats, 4 * n, "dquats"), data(log_scales, 2 * n, "dlog_scales"),
          data(opacity_logits, n, "dopacity_logits"), data(beta_raw, n, "dbeta_raw")};
}

// The number of a view colour, as in ViewColorArrays.
inline int kind_number(const std::string& kind) {
  const char* names[] = {"sv", "sh", "sb", "sg"};
  for (int i = 0; i < 4; ++i)
    if (kind == names[i]) return i;
  throw std::invalid_argument("unknown view colour '" + kind + "'");
}

}  // namespace bt
