// Module bitymi_ns._cpu, or one of another name for other CPU features. Operations take the fields of their struct
// (csrc/ops) as keyword arguments; shapes and dtypes are checked here (reader.h), values in Python.
#include <nanobind/stl/optional.h>

#include <cstdlib>

#include "bindings/reader.h"

#if defined(__GLIBC__) || __has_include(<malloc.h>)
#include <malloc.h>
#endif

#include "core/blend.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {
namespace {
using namespace nb::literals;

// Blocks of this size are always mapped from the system and unmapped when freed (glibc).
constexpr size_t kFromSystem = size_t(32) << 20;

void prepare(void* at, size_t bytes) {
  if (bytes >= kFromSystem) use_large_pages(at, bytes);
}

const Device kHost = {nb::device::cpu::value, "the CPU", false, prepare};

// Process-wide settings for fast kernels; not on import, so that reading a constant changes neither threads nor memory.
void set_up_process() {
#if defined(__GLIBC__)
  // Every view allocates and frees tens of megabytes; unmapping them costs more in page faults than computing in them.
  if (!std::getenv("MALLOC_TRIM_THRESHOLD_")) {
    mallopt(M_MMAP_THRESHOLD, kFromSystem);
    mallopt(M_TRIM_THRESHOLD, 1 << 30);
    mallopt(M_TOP_PAD, 64 << 20);
  }
#endif
  wait_without_spinning();
}

// Returns freed memory that is kept for later views to the system.
void give_back_memory() {
#if defined(__GLIBC__)
  malloc_trim(0);
#endif
}

template <class Arguments> void bind_operation(nb::module_& m, const std::string& name, void (*run)(const Arguments&)) {
  m.def(name.c_str(), [name, run](const nb::kwargs& kwargs) {
    Reader r(name, kwargs, kHost);
    const Arguments a = read<Arguments>(r);
    nb::gil_scoped_release release;
    run(a);
  });
}

template <class S> void bind_tracer(nb::module_& m) {
  const std::string name = std::string("Trace") + kSuffix<S>;
  nb::class_<Trace<S>>(m, name.c_str())
      .def(nb::init<>())
      .def("run",
           [](Trace<S>& t, const nb::kwargs& kwargs) {
             Reader r("Trace.run", kwargs, kHost);
             const TraceForward<S> a = read<TraceForward<S>>(r);
             nb::gil_scoped_release release;
             trace_forward(a, t);
             return t.list.total;
           })
      .def_prop_ro("tiles", [](const Trace<S>& t) { return int64_t(t.bins.tiles_x) * t.bins.tiles_y; })
      .def_prop_ro("pairs", [](const Trace<S>& t) { return int64_t(t.bins.surfels.size()); })
      .def_prop_ro("blocks", [](const Trace<S>& t) { return t.list.blocks; })
      .def("copy", [](Trace<S>& t, const nb::kwargs& kwargs) {
        Reader r("Trace.copy", kwargs, kHost);
        const TraceCopy<S> a = read<TraceCopy<S>>(r);
        nb::gil_scoped_release release;
        trace_copy(a, t);
      });
}

using Numbers = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Others = std::optional<nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>>;

IntegerColumn integer_column(const Numbers& values, int64_t blocks, const Others& others) {
  const int64_t rows = int64_t(values.size());
  if (blocks < 0 || (blocks && rows % blocks) || (others && int64_t(others->size()) != rows))
    throw std::invalid_argument("blocks or others do not fit the rows");
  return {rows, blocks, others ? others->data() : nullptr};
}

void bind_entropy(nb::module_& m) {
  nb::exception<DamagedStream>(m, "DamagedStream", PyExc_ValueError);
  m.def(
      "encode_integers",
      [](const Numbers& values, int64_t blocks, const Others& others) {
        const IntegerColumn column = integer_column(values, blocks, others);
        std::string found;
        {
          nb::gil_scoped_release release;
          found = encode_integers(column, values.data());
        }
        return nb::bytes(found.data(), found.size());
      },
      "values"_a, "blocks"_a, "others"_a.none(), "Code a number of every row of a column (cpu/kernels.h).");
  m.def(
      "decode_integers",
      [](const nb::bytes& data, const Numbers& values, int64_t blocks, const Others& others) {
        const IntegerColumn column = integer_column(values, blocks, others);
        nb::gil_scoped_release release;
        decode_integers(column, reinterpret_cast<const uint8_t*>(data.c_str()), data.size(), values.data());
      },
      "data"_a, "values"_a, "blocks"_a, "others"_a.none(), "Fill `values` from what encode_integers gave.");
}

template <class S> void bind_operations(nb::module_& m) {
  const auto name = [](const char* base) { return std::string(base) + kSuffix<S>; };
  bind_class<FieldArrays<S>>(m, name("Field"), kHost, "The parameters of a residual field.");
#define BT_BIND(operation) bind_operation(m, name(#operation), &operation<S>);
  BT_OPERATIONS(BT_BIND)
#undef BT_BIND
  bind_tracer<S>(m);
  bind_operation(m, name("baked_forward"), &baked_forward<S>);
  bind_operation(m, name("select_fragments"), &select_fragments<S>);
  bind_operation(m, name("surfel_coverage"), &surfel_coverage<S>);
  bind_operation(m, name("texel_coverage"), &texel_coverage<S>);
  bind_operation(m, name("sparse_cosines"), &sparse_cosines<S>);
  bind_operation(m, name("decode_cosines"), &decode_cosines<S>);
  bind_operation(m, name("rank_sites"), &rank_sites<S>);
  bind_operation(m, name("fit_sites"), &fit_sites<S>);
}
}  // namespace
}  // namespace bt

NB_MODULE(BITYMI_MODULE, m) {
  using namespace bt;
  nb::set_leak_warnings(false);  // tracers live until the process ends
  use_one_thread_after_fork();
  m.doc() = "CPU kernels: see bitymi_ns.ops for their meaning.";
  m.attr("CPU_FEATURES") = BITYMI_CPU_FEATURES;  // required CPU features, as named by bitymi_ns._cpu_features
  nb::class_<Bins>(m, "Bins", "Memory for a view's tile lists, kept from frame to frame.").def(nb::init<>());
  nb::class_<Patches>(m, "Patches", "An atlas, every surfel's tile in one run.")
      .def("__init__", [](Patches* self, const nb::kwargs& kwargs) {
        Reader r("Patches", kwargs, kHost);
        const Pages p = read<Pages>(r);
        new (self) Patches();
        nb::gil_scoped_release release;
        gather_patches(p, *self);
      });
  bind_class<TileBlocks>(m, "TileBlocks", kHost, "The tiles and blocks of a fragment list.");
  bind_operations<float>(m);
  bind_operations<double>(m);
  bind_entropy(m);
  bind_operation(m, "masked_counts", &masked_counts);
  bind_operation(m, "list_ids", &list_ids);
  m.attr("SUPPORT") = kSupport, m.attr("ALPHA_MAX") = kAlphaMax, m.attr("ALPHA_MIN") = kAlphaMin;
  m.attr("TRANSMITTANCE_MIN") = kTransmittanceMin, m.attr("BETA_MAX") = kBetaMax, m.attr("TILE") = kTile;
  m.attr("GEOM") = int(kGeom), m.attr("FRAME") = kFrame;
  m.attr("IMAGE_CHANNELS") = kImageChannels, m.attr("MAP_CHANNELS") = kMapChannels;
  m.attr("BAKED_CHANNELS") = kBakedChannels;
  m.attr("FEATURES") = kFeatures, m.attr("WIDTH") = kWidth, m.attr("MAX_LEVELS") = kMaxLevels;
  m.attr("MAX_TERMS") = kMaxTerms, m.attr("LOG_TAU_MAX") = kLogTauMax, m.attr("SH_C0") = kShC0;
  m.attr("COLOR_BIAS") = kColorBias;
  m.def("set_up_process", &set_up_process, "Before the first kernel: threads that wait asleep, memory that is kept.");
  m.def("give_back_memory", &give_back_memory, "Return freed memory to the system.");
  m.def("set_num_threads", &set_num_threads, "n"_a, "Threads of the kernels; 0 = as many as there are cores.");
  m.def("num_threads", &num_threads);
}
