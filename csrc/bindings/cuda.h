// Shared by the bindings of the CUDA kernels. Compiled with BITYMI_EMULATED they take host arrays and run on the host.
#pragma once

#include "bindings/arrays.h"
#include "cuda/kernels.h"

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

void bind_project(nb::module_& m);

}  // namespace bt::cuda
