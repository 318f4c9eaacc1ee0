# bitymi_ns._cuda where there is a CUDA compiler, and bitymi_ns._emulated, the same kernels on the host, for tests.

file(GLOB cuda_kernels CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/csrc/cuda/*.cu)
file(GLOB cuda_bindings CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/csrc/bindings/cuda*.cpp)

if(BITYMI_EMULATED_CUDA)
  # The compiler would hand .cu files to nvcc: each is included by a C++ file made here.
  set(emulated_sources ${CMAKE_CURRENT_SOURCE_DIR}/csrc/cuda/emulator.cpp)
  set(emulated_kernels ${CMAKE_CURRENT_SOURCE_DIR}/csrc/cuda/emulator_probe.cpp)
  foreach(kernel ${cuda_kernels})
    get_filename_component(name ${kernel} NAME_WE)
    set(wrapper ${CMAKE_CURRENT_BINARY_DIR}/emulated/${name}.cpp)
    file(CONFIGURE OUTPUT ${wrapper} CONTENT "#include \"cuda/${name}.cu\"\n")
    list(APPEND emulated_kernels ${wrapper})
  endforeach()
  # what a GPU would refuse; the emulator says where
  set_source_files_properties(${emulated_kernels} PROPERTIES COMPILE_OPTIONS -fsanitize=alignment)
  nanobind_add_module(_emulated NB_STATIC NOMINSIZE NB_DOMAIN _emulated ${emulated_sources} ${emulated_kernels} ${cuda_bindings})
  target_include_directories(_emulated PRIVATE ${CMAKE_CURRENT_SOURCE_DIR}/csrc)
  target_compile_definitions(_emulated PRIVATE BITYMI_EMULATED)
  target_compile_options(_emulated PRIVATE -O2 -Wall -Wextra -ffp-contract=off)
  if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    # kernels are included, so g++ takes their anonymous namespaces for those of headers
    target_compile_options(_emulated PRIVATE -Wno-subobject-linkage)
  endif()
  install(TARGETS _emulated LIBRARY DESTINATION bitymi_ns)
endif()

include(cmake/find_cuda.cmake)
find_cuda()
if(why)
  if(BITYMI_CUDA STREQUAL "ON")
    message(FATAL_ERROR "BITYMI_CUDA=ON, but ${why}.")
  endif()
  message(STATUS "The package is built for the CPU alone: ${why}")
elseif(note)
  message(STATUS "CUDA: ${note}")
endif()
# pip hides the lines above: the package says why.
file(CONFIGURE OUTPUT ${CMAKE_CURRENT_BINARY_DIR}/_cuda_build.py @ONLY CONTENT [[
"""Why there are no CUDA kernels (empty: there are), and what this machine's GPUs lack. Written by CMake."""

WHY_NOT = r"""@why@"""
NOTE = r"""@note@"""
]])
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/_cuda_build.py DESTINATION bitymi_ns)
if(why)
  return()
endif()

# Before the language is enabled: CMake would choose an architecture itself. Machine code for each; what later GPUs
# compile it from (PTX) for the newest alone.
set(CMAKE_CUDA_ARCHITECTURES ${BITYMI_CUDA_ARCHITECTURES})
list(POP_BACK CMAKE_CUDA_ARCHITECTURES newest)
list(TRANSFORM CMAKE_CUDA_ARCHITECTURES APPEND -real REGEX "^[0-9]+$")
list(APPEND CMAKE_CUDA_ARCHITECTURES ${newest})
enable_language(CUDA)
list(JOIN BITYMI_CUDA_ARCHITECTURES ", " architectures)
message(STATUS "CUDA kernels for ${architectures} by nvcc ${CMAKE_CUDA_COMPILER_VERSION}")

# The library holds the kernels and a static runtime: the module imports on a machine without a driver.
add_library(bitymi_cuda STATIC ${cuda_kernels})
target_include_directories(bitymi_cuda PRIVATE ${CMAKE_CURRENT_SOURCE_DIR}/csrc)
set_target_properties(bitymi_cuda PROPERTIES
  POSITION_INDEPENDENT_CODE ON CUDA_STANDARD 17 CUDA_STANDARD_REQUIRED ON CUDA_RUNTIME_LIBRARY Static
  CUDA_VISIBILITY_PRESET hidden)
# Not the list itself: its semicolons would end the command of the shell.
target_compile_definitions(bitymi_cuda PRIVATE BITYMI_ARCHITECTURES="${architectures}")
# Without -lineinfo, which takes four fifths of the compiler's time and two thirds of the size: CMAKE_CUDA_FLAGS adds it.
target_compile_options(bitymi_cuda PRIVATE --expt-relaxed-constexpr -Xcompiler=-Wall)
# What one kernel counts another one lists: were products and sums fused in one of them and not in the other, their bounds
# would differ in the last bit, and now and then by a tile.
set_source_files_properties(${CMAKE_CURRENT_SOURCE_DIR}/csrc/cuda/bin.cu PROPERTIES COMPILE_OPTIONS --fmad=false)
find_package(CUDAToolkit REQUIRED)
nanobind_add_module(_cuda NB_STATIC NOMINSIZE NB_DOMAIN _cuda ${cuda_bindings})
target_include_directories(_cuda PRIVATE ${CMAKE_CURRENT_SOURCE_DIR}/csrc)
target_link_libraries(_cuda PRIVATE bitymi_cuda CUDA::cudart_static)
install(TARGETS _cuda LIBRARY DESTINATION bitymi_ns)
