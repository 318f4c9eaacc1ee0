// Check of a device by an empty kernel.
#include "cuda/kernels.h"

namespace bt::cuda {

#if defined(__CUDACC__)

namespace {
__global__ void probe_kernel() {}

std::string version(int number) { return std::to_string(number / 1000) + "." + std::to_string(number % 1000 / 10); }
}  // namespace

std::string device_problem(int device) {
  int driver = 0, runtime = 0;
  cudaDriverGetVersion(&driver);
  cudaRuntimeGetVersion(&runtime);
  if (!driver) return "there is no NVIDIA driver";
  if (driver / 1000 < runtime / 1000)
    return "the NVIDIA driver supports CUDA " + version(driver) + ", and the kernels were built with CUDA " +
           version(runtime) + ": update the driver, or install bitymi-ns again with an older toolkit";
  int before = 0;
  cudaError_t error = cudaGetDevice(&before);
  if (error == cudaSuccess) error = cudaSetDevice(device);
  cudaFuncAttributes attributes;
  if (error == cudaSuccess) error = cudaFuncGetAttributes(&attributes, probe_kernel);
  std::string problem;
  if (error == cudaErrorNoKernelImageForDevice || error == cudaErrorInvalidDeviceFunction) {
    int major = 0, minor = 0;
    cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device);
    cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device);
    problem = "the kernels were built for the compute capabilities " BITYMI_ARCHITECTURES ", and this GPU has " +
              std::to_string(major) + std::to_string(minor) +
              ": install bitymi-ns again on this machine, or with -Ccmake.define.BITYMI_CUDA_ARCHITECTURES=" +
              std::to_string(major) + std::to_string(minor);
  } else if (error != cudaSuccess) {
    problem = std::string("the CUDA device cannot be used: ") + cudaGetErrorString(error);
  }
  cudaGetLastError();  // not to be reported by a later call
  cudaSetDevice(before);
  return problem;
}

#else

std::string device_problem(int) { return ""; }

#endif

}  // namespace bt::cuda
