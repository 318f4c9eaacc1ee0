// Shared by the bindings of the CPU kernels.
#pragma once

#include "bindings/arrays.h"
#include "cpu/kernels.h"

namespace bt {
using namespace nb::literals;

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Maybe = std::optional<Array<T>>;

template <class S>
FragmentArrays<S> fragments(int64_t n, const Array<int32_t>& surfel, const Array<int32_t>& pixel,
                            const Array<S>& weight, const Array<S>& uv, const Array<S>& depth, const Array<S>& sigma) {
  return {data(surfel, n, "surfel"), data(pixel, n, "pixel"), data(weight, n, "weight"),
          data(uv, 2 * n, "uv"),     data(depth, n, "depth"), data(sigma, n, "sigma")};
}
// tile_start [tiles + 1] of f fragments
inline int64_t tiles_of(const Array<const int64_t>& tile_start, int64_t f) {
  const int64_t tiles = int64_t(tile_start.size()) - 1;
  if (tiles < 0 || tile_start.data()[0] != 0 || tile_start.data()[tiles] != f)
    throw std::invalid_argument("tile_start does not belong to these fragments");
  return tiles;
}

void bind_visibility(nb::module_& m);
void bind_appearance(nb::module_& m);

}  // namespace bt
