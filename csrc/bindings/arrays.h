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

}  // namespace bt
