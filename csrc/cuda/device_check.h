// Whether the kernels can run on a device.
#pragma once

#include <string>

namespace bt::cuda {

// Why the kernels cannot run on CUDA device number `device`, and what to do about it; empty when they can. Looks
// without running anything.
std::string device_problem(int device);

}  // namespace bt::cuda
