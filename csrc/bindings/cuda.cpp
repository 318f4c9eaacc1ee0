// bitymi_ns._cuda: the functions of bitymi_ns._cpu for arrays on a CUDA device, each with the stream that it runs on.
// The same file with BITYMI_EMULATED is bitymi_ns._emulated, which runs the CUDA kernels on the host, for tests.
#include "bindings/cuda.h"

#include <nanobind/stl/string.h>

#include "cuda/device_check.h"

using namespace nanobind::literals;

#if defined(BITYMI_EMULATED)
NB_MODULE(_emulated, m) {
  m.doc() = "The CUDA kernels, thread by thread on the host: for tests.";
  m.def("set_seed", &bt::emulator::set_seed, "seed"_a, "Seed of the order in which a block's threads take turns.");
#else
NB_MODULE(_cuda, m) {
  m.doc() = "CUDA kernels: see bitymi_ns.ops for their meaning.";
#endif
  m.def("device_problem", &bt::cuda::device_problem, "device"_a,
        "Why the kernels cannot run on a CUDA device and what to do about it; empty when they can.");
  bt::cuda::bind_project(m);
  bt::cuda::bind_trace(m);
  bt::cuda::bind_baked(m);
  bt::cuda::bind_field(m);
  bt::cuda::bind_appearance(m);
}
