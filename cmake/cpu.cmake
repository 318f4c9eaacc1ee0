# Which CPU the module _cpu is compiled for, and the record of it that Python reads before it loads the module: an
# instruction that a CPU lacks ends the process without a word.

set(march "")
if(CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|AMD64|amd64)$")
  # A wheel may be copied to another machine, what is built in place (editable, or by cmake alone) stays here.
  if(SKBUILD_STATE STREQUAL "wheel")
    set(march x86-64-v3)
  else()
    set(march native)
  endif()
endif()
set(BITYMI_MARCH "${march}" CACHE STRING
  "The CPU to compile for, as in -march=; on x86-64 native, in a wheel x86-64-v3; empty: the compiler's default")

set(cpu_options "")
set(cpu_features "")
if(CMAKE_CXX_COMPILER_ID MATCHES "GNU|Clang")
  if(BITYMI_MARCH)
    include(CheckCXXCompilerFlag)
    string(MAKE_C_IDENTIFIER "BITYMI_HAS_MARCH_${BITYMI_MARCH}" known)
    check_cxx_compiler_flag(-march=${BITYMI_MARCH} ${known})
    if(NOT ${known})
      message(FATAL_ERROR "${CMAKE_CXX_COMPILER} does not know -march=${BITYMI_MARCH}: use GCC 12, Clang 12 or newer, or "
        "name another CPU with -Ccmake.define.BITYMI_MARCH=... (pip) or -DBITYMI_MARCH=... (cmake)")
    endif()
    set(cpu_options -march=${BITYMI_MARCH})
  endif()
  separate_arguments(cxx_flags NATIVE_COMMAND "${CMAKE_CXX_FLAGS}")
  execute_process(COMMAND ${CMAKE_CXX_COMPILER} ${cxx_flags} ${cpu_options} -dM -E -x c++ /dev/null
    OUTPUT_VARIABLE macros COMMAND_ERROR_IS_FATAL ANY)
  set(named "")
  if(BITYMI_MARCH STREQUAL "native" AND EXISTS /proc/cpuinfo)
    file(STRINGS /proc/cpuinfo named REGEX "^flags" LIMIT_COUNT 1)
  endif()
  # The compiler's names of what it may use unasked, and Linux's in /proc/cpuinfo where they are not the same.
  foreach(feature
      SSE3=pni SSSE3 SSE4_1 SSE4_2 SSE4A POPCNT LZCNT=abm MOVBE BMI=bmi1 BMI2 TBM GFNI F16C FMA FMA4 XOP
      AVX AVX2 AVXVNNI=avx_vnni AVX512F AVX512CD AVX512BW AVX512DQ AVX512VL AVX512IFMA AVX512VBMI
      AVX512VBMI2=avx512_vbmi2 AVX512VNNI=avx512_vnni AVX512BITALG=avx512_bitalg
      AVX512VPOPCNTDQ=avx512_vpopcntdq AVX512BF16=avx512_bf16 AVX512FP16=avx512_fp16)
    string(REGEX MATCH "^[^=]+" macro ${feature})
    string(REGEX MATCH "[^=]+$" name ${feature})
    string(TOLOWER ${name} name)
    # A kernel that is older than the CPU does not name all it has: what is not named here cannot be asked for later.
    if(macros MATCHES "#define __${macro}__ 1\n" AND (NOT named OR "${named} " MATCHES " ${name} "))
      list(APPEND cpu_features ${name})
    endif()
  endforeach()
endif()
list(JOIN cpu_features " " cpu_features)
message(STATUS "CPU kernels for '${BITYMI_MARCH}': ${cpu_features}")
file(CONFIGURE OUTPUT ${CMAKE_CURRENT_BINARY_DIR}/_cpu_features.py @ONLY CONTENT [[
"""What the CPU kernels were compiled for; written by CMake."""

FEATURES = "@cpu_features@"
]])
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/_cpu_features.py DESTINATION bitymi_ns)
