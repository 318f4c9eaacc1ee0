// bitymi_ns._cpu, or a module of another name for another CPU: arrays in, arrays out. The caller allocates; shapes and
// dtypes are checked here, values in Python.
#include "bindings/cpu.h"

#include <nanobind/stl/tuple.h>

#if defined(__GLIBC__) || __has_include(<malloc.h>)
#include <malloc.h>
#endif

#include "core/shading.h"
#include "cpu/threads.h"

namespace {
// Settings of the whole process that the kernels are fast with. Not made on import: who only reads a constant keeps his
// threads and his memory as they are.
void set_up_process() {
#if defined(__GLIBC__)
  // Every view allocates and frees the same tens of megabytes. Given back to the system in between, they cost more in
  // page faults than what is computed in them.
  mallopt(M_MMAP_THRESHOLD, 32 << 20);
  mallopt(M_TRIM_THRESHOLD, 1 << 30);
  mallopt(M_TOP_PAD, 64 << 20);
#endif
  bt::wait_without_spinning();
}
}  // namespace

NB_MODULE(BITYMI_MODULE, m) {
  using namespace bt;
  nb::set_leak_warnings(false);  // tracers keep their memory until the process ends
  m.doc() = "CPU kernels: see bitymi_ns.ops for their meaning.";
  m.attr("CPU_FEATURES") = BITYMI_CPU_FEATURES;  // what of a CPU this needs, as in bitymi_ns._cpu_features
  nb::class_<Patches>(m, "Patches", "An atlas, every surfel's tile in one run.")
      .def(
          "__init__",
          [](Patches* self, Maybe<const uint8_t> bytes, Maybe<const float> floats, std::tuple<int, int, int> shape,
             Array<const int32_t> tiles) {
            const auto [layers, rows, columns] = shape;
            const int64_t texels = int64_t(layers) * rows * columns * 4, n = int64_t(tiles.size()) / 5;
            const uint8_t* b = data_or_null(bytes, texels, "atlas bytes");
            const float* f = data_or_null(floats, texels, "atlas floats");
            data(tiles, 5 * n, "tiles");
            new (self) Patches();
            nb::gil_scoped_release release;
            gather_patches(layers, rows, columns, b, f, n, tiles.data(), *self);
          },
          "bytes"_a.noconvert().none(), "floats"_a.noconvert().none(), "shape"_a, "tiles"_a.noconvert());
  bind_visibility(m);
  bind_appearance(m);
  m.def(
      "masked_counts",
      [](Array<const int32_t> surfel, Array<const int32_t> pixel, Array<const uint8_t> mask, Array<int32_t> counts) {
        const int64_t n = int64_t(surfel.size());
        masked_counts(n, surfel.data(), data(pixel, n, "pixel"), mask.data(), counts.data());
      },
      "surfel"_a.noconvert(), "pixel"_a.noconvert(), "mask"_a.noconvert(), "counts"_a.noconvert());
  m.attr("SUPPORT") = kSupport, m.attr("ALPHA_MAX") = kAlphaMax, m.attr("ALPHA_MIN") = kAlphaMin;
  m.attr("TRANSMITTANCE_MIN") = kTransmittanceMin, m.attr("BETA_MAX") = kBetaMax, m.attr("TILE") = kTile;
  m.attr("GEOM") = int(kGeom), m.attr("FRAME") = kFrame;
  m.attr("IMAGE_CHANNELS") = kImageChannels, m.attr("MAP_CHANNELS") = kMapChannels;
  m.attr("BAKED_CHANNELS") = kBakedChannels;
  m.attr("FEATURES") = kFeatures, m.attr("WIDTH") = kWidth, m.attr("MAX_LEVELS") = kMaxLevels;
  m.attr("MAX_TERMS") = kMaxTerms, m.attr("LOG_TAU_MAX") = kLogTauMax, m.attr("SH_C0") = kShC0;
  m.attr("COLOR_BIAS") = kColorBias;
  m.def("set_up_process", &set_up_process, "Before the first kernel: threads that wait asleep, memory that is kept.");
  m.def("set_num_threads", &set_num_threads, "n"_a, "Threads of the kernels; 0 = as many as there are cores.");
  m.def("num_threads", &num_threads);
}
