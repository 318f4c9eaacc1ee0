// Shared by the bindings of the CUDA kernels. Compiled with BITYMI_EMULATED they take host arrays and run on the host.
#pragma once

#include "bindings/arrays.h"
#include "cuda/kernels.h"
#include "cuda/trace.h"

namespace bt::cuda {

using namespace nb::literals;

#if defined(BITYMI_EMULATED)
using Where = nb::device::cpu;
#else
using Where = nb::device::cuda;
#endif

template <class T>
using Array = nb::ndarray<T, nb::c_contig, Where>;
template <class T>
using Maybe = std::optional<Array<T>>;

// torch gives a stream as a number
inline Stream stream_of(uintptr_t handle) { return reinterpret_cast<Stream>(handle); }

// The structure of a fragment list, made once per view: a CUDA kernel's counterpart of tile_start.
struct PairsHandle {
  Array<const int32_t> surfel, slot, masks;
  Array<const int64_t> offsets, tile_pairs;
  Array<const int32_t> order;
  Array<const int64_t> slot_start;  // the arrays keep their memory alive
  Pairs pairs;
  int64_t fragments;
};
// data() of floating-point rows that kernels read 16 bytes at a time
template <class S>
const S* rows(const Array<const S>& a, int64_t size, const char* name) {
  const S* p = data(a, size, name);
  if (reinterpret_cast<uintptr_t>(p) % 16)
    throw std::invalid_argument(std::string(name) + " must start at a multiple of 16 bytes");
  return p;
}
template <class S>
FragmentArrays<S> fragments(int64_t n, const Array<int32_t>& surfel, const Array<int32_t>& pixel,
                            const Array<S>& weight, const Array<S>& uv, const Array<S>& depth, const Array<S>& sigma) {
  return {n,
          data(surfel, n, "surfel"),
          data(pixel, n, "pixel"),
          data(weight, n, "weight"),
          data(uv, 2 * n, "uv"),
          data(depth, n, "depth"),
          data(sigma, n, "sigma")};
}

void bind_project(nb::module_& m);
void bind_trace(nb::module_& m);
void bind_baked(nb::module_& m);
void bind_field(nb::module_& m);
void bind_appearance(nb::module_& m);

}  // namespace bt::cuda
