# bitymi_ns._cpu, compiled for one CPU or once for each of several, and the record of what each needs, which Python reads
# before it loads one: an instruction that a CPU lacks ends the process without a word.

file(GLOB cpu_sources CONFIGURE_DEPENDS
  ${CMAKE_CURRENT_SOURCE_DIR}/csrc/cpu/*.cpp ${CMAKE_CURRENT_SOURCE_DIR}/csrc/bindings/cpu*.cpp)
if(NOT cpu_sources)
  message(FATAL_ERROR "no sources in csrc/cpu and csrc/bindings: the checkout is incomplete")
endif()

set(march default)
if(CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|AMD64|amd64)$")
  # A wheel may be copied to another machine, what is built in place (editable, or by cmake alone) stays here.
  if(SKBUILD_STATE STREQUAL "wheel")
    set(march x86-64-v3 x86-64-v4)  # AVX2, AVX-512
  else()
    set(march native)
  endif()
endif()
set(BITYMI_MARCH "${march}" CACHE STRING "The CPUs to compile for, as in -march=, each with all of the one before, or \
default: the compiler's. On x86-64 native, in a wheel x86-64-v3;x86-64-v4")

# The compiler's names of what it may use unasked, with Linux's in /proc/cpuinfo where they are not the same.
set(known_features
  SSE3=pni SSSE3 SSE4_1 SSE4_2 SSE4A POPCNT LZCNT=abm MOVBE BMI=bmi1 BMI2 TBM GFNI F16C FMA FMA4 XOP
  AVX AVX2 AVXVNNI=avx_vnni AVX512F AVX512CD AVX512BW AVX512DQ AVX512VL AVX512IFMA AVX512VBMI AVX512VBMI2=avx512_vbmi2
  AVX512VNNI=avx512_vnni AVX512BITALG=avx512_bitalg AVX512VPOPCNTDQ=avx512_vpopcntdq AVX512BF16=avx512_bf16
  AVX512FP16=avx512_fp16)

# What the compiler may use with `options`, by Linux's names.
function(cpu_features result options)
  separate_arguments(flags NATIVE_COMMAND "${CMAKE_CXX_FLAGS}")
  execute_process(COMMAND ${CMAKE_CXX_COMPILER} ${flags} ${options} -dM -E -x c++ /dev/null
    OUTPUT_VARIABLE macros COMMAND_ERROR_IS_FATAL ANY)
  set(named "")
  if(options STREQUAL "-march=native" AND EXISTS /proc/cpuinfo)
    file(STRINGS /proc/cpuinfo named REGEX "^flags" LIMIT_COUNT 1)
  endif()
  set(found "")
  foreach(feature ${known_features})
    string(REGEX MATCH "^[^=]+" macro ${feature})
    string(REGEX MATCH "[^=]+$" name ${feature})
    string(TOLOWER ${name} name)
    # A kernel that is older than the CPU does not name all it has: what is not named here cannot be asked for later.
    if(macros MATCHES "#define __${macro}__ 1\n" AND (NOT named OR "${named} " MATCHES " ${name} "))
      list(APPEND found ${name})
    endif()
  endforeach()
  list(JOIN found " " found)
  set(${result} "${found}" PARENT_SCOPE)
endfunction()

include(CheckCXXCompilerFlag)
set(name _cpu)
set(record "")
foreach(cpu ${BITYMI_MARCH})
  if(record)
    string(MAKE_C_IDENTIFIER "_cpu_${cpu}" name)
  endif()
  # NOMINSIZE: nanobind otherwise compiles its modules with -Os.
  nanobind_add_module(${name} NB_STATIC NOMINSIZE NB_DOMAIN ${name} ${cpu_sources})
  target_include_directories(${name} PRIVATE ${CMAKE_CURRENT_SOURCE_DIR}/csrc)
  set(features "")
  if(CMAKE_CXX_COMPILER_ID MATCHES "GNU|Clang")
    set(options "")
    if(NOT cpu STREQUAL "default")
      set(options -march=${cpu})
      string(MAKE_C_IDENTIFIER "BITYMI_HAS_MARCH_${cpu}" known)
      check_cxx_compiler_flag(${options} ${known})
      if(NOT ${known})
        message(FATAL_ERROR "${CMAKE_CXX_COMPILER} does not know ${options}: use GCC 11, Clang 12 or newer, or name "
          "another CPU with -Ccmake.define.BITYMI_MARCH=... (pip) or -DBITYMI_MARCH=... (cmake)")
      endif()
    endif()
    cpu_features(features "${options}")
    # No -ffast-math: NaN and infinity must stay what they are, they are tested for.
    # -Wno-psabi: Lanes are wider than registers, but functions that take them are inlined or stay in their file.
    # -Wno-bitwise-instead-of-logical: masks are joined by & whether they are of one number or of sixteen.
    target_compile_options(${name} PRIVATE
      -O3 -fno-math-errno -ffp-contract=fast -Wall -Wextra -Wno-psabi
      $<$<CXX_COMPILER_ID:Clang,AppleClang>:-Wno-bitwise-instead-of-logical> ${options})
  endif()
  message(STATUS "CPU kernels ${name} for ${cpu}: ${features}")
  string(APPEND record "    \"${name}\": \"${features}\",\n")
  # The features also so that a build folder that comes to another machine, where `native` means less, is compiled anew.
  target_compile_definitions(${name} PRIVATE BITYMI_MODULE=${name} BITYMI_CPU_FEATURES="${features}")

  if(BITYMI_SANITIZE)
    # the first finding ends the run; conversions of floats that do not fit are findings as well
    set(sanitizers -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all -fno-omit-frame-pointer)
    target_compile_options(${name} PRIVATE ${sanitizers} -O1 -g1)
    target_link_options(${name} PRIVATE ${sanitizers})
  endif()

  if(OpenMP_CXX_FOUND)
    target_link_libraries(${name} PRIVATE OpenMP::OpenMP_CXX)
  elseif(CMAKE_CXX_COMPILER_ID MATCHES "GNU|Clang")
    target_compile_options(${name} PRIVATE -Wno-unknown-pragmas)
  endif()
  install(TARGETS ${name} LIBRARY DESTINATION bitymi_ns)
endforeach()

file(CONFIGURE OUTPUT ${CMAKE_CURRENT_BINARY_DIR}/_cpu_features.py @ONLY CONTENT [[
"""The modules of CPU kernels and what of a CPU each needs, by /proc/cpuinfo's names. Written by CMake."""

FEATURES = {
@record@}
]])
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/_cpu_features.py DESTINATION bitymi_ns)
