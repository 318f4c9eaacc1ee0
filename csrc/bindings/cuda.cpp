// bitymi_ns._cuda: the operations of bitymi_ns._cpu for arrays on a CUDA device, each with a stream. Compiled with
// BITYMI_EMULATED it is bitymi_ns._emulated, which runs the CUDA kernels on the host, for tests.
#include <nanobind/stl/vector.h>

#include "bindings/reader.h"
#include "cuda/atlas_texture.h"
#include "cuda/baked.h"
#include "cuda/kernels.h"
#include "cuda/training.h"
#include "cuda/training_view.h"

namespace bt::cuda {
namespace {
using namespace nb::literals;

#if defined(BITYMI_EMULATED)
const Device kCard = {nb::device::cpu::value, "the CPU", true};
#else
const Device kCard = {nb::device::cuda::value, "a CUDA device", true};
#endif

// Arguments and stream; torch passes streams as integers.
template <class Arguments> struct OnStream {
  Arguments arguments;
  uint64_t stream;

  template <class R> void fields(R& r) {
    arguments.fields(r);
    if (r.has("stream")) r.number("stream", stream);
  }
};
template <class Arguments>
void bind_operation(nb::module_& m, const std::string& name, void (*run)(const Arguments&, Stream)) {
  m.def(name.c_str(), [name, run](const nb::kwargs& kwargs) {
    Reader r(name, kwargs, kCard);
    const auto a = read<OnStream<Arguments>>(r);
    run(a.arguments, reinterpret_cast<Stream>(uintptr_t(a.stream)));
  });
}

// Binds one call for many parameters: a list of dictionaries of arguments.
template <class S> void bind_adam(nb::module_& m, const std::string& name) {
  m.def(
      name.c_str(),
      [name](const nb::list& parameters, uint64_t stream) {
        std::vector<AdamParameter<S>> found;
        for (nb::handle each : parameters) {
          Reader r(name, nb::cast<nb::kwargs>(each), kCard);
          found.push_back(read<AdamParameter<S>>(r));
        }
        adam(found.data(), int(found.size()), reinterpret_cast<Stream>(uintptr_t(stream)));
      },
      "parameters"_a, "stream"_a = 0, "Steps Adam on parameters, a dictionary of arguments for each.");
}
template <class S> void bind_training_view(nb::module_& m) {
  const auto name = [](const char* base) { return std::string(base) + kSuffix<S>; };
  bind_class<TrainingView<S>>(m, name("TrainingView"), kCard, "A training view (csrc/cuda/training_view.h).")
      .def(
          "count",
          [](const Held<TrainingView<S>>& view, uint64_t stream) {
            const nb::gil_scoped_release others_run;
            return count_view<S>(view, reinterpret_cast<Stream>(uintptr_t(stream)));
          },
          "stream"_a = 0, "Project the surfels; wait for the number of pairs and return it.");
  bind_operation(m, name("draw_view"), &draw_view<S>);
  bind_operation(m, name("differentiate_view"), &differentiate_view<S>);
  m.def(name("training_view_workspace").c_str(), &training_view_workspace<S>, "n"_a, "width"_a, "height"_a);
}

template <class S> void bind_operations(nb::module_& m) {
  const auto name = [](const char* base) { return std::string(base) + kSuffix<S>; };
  bind_class<FieldArrays<S>>(m, name("Field"), kCard, "The parameters of a residual field.");
#define BT_BIND(operation) bind_operation(m, name(#operation), &operation<S>);
  BT_OPERATIONS(BT_BIND)
#undef BT_BIND
  bind_operation(m, name("bin_count"), &bin_count<S>);
  bind_operation(m, name("bin_fill"), &bin_fill<S>);
  bind_operation(m, name("trace_mark"), &trace_mark<S>);
  bind_operation(m, name("trace_fill"), &trace_fill<S>);
  bind_operation(m, name("rasterize_forward"), &rasterize_forward<S>);
  bind_operation(m, name("rasterize_backward"), &rasterize_backward<S>);
  bind_operation(m, name("accumulate_statistics"), &accumulate_statistics<S>);
  bind_adam<S>(m, name("adam"));
  bind_training_view<S>(m);
  // bytes of working memory
  m.def(name("bin_count_workspace").c_str(), &bin_count_workspace<S>, "n"_a);
  m.def(name("bin_fill_workspace").c_str(), &bin_fill_workspace, "pairs"_a, "width"_a, "height"_a);
  m.def(name("trace_mark_workspace").c_str(), &trace_mark_workspace, "pairs"_a);
  m.def(name("ssim_workspace").c_str(), &ssim_workspace<S>, "height"_a, "width"_a, "channels"_a, "gradient"_a);
}

struct Texels {
  int format, height, width;
  const uint8_t* texels;

  template <class R> void fields(R& r) {
    r.choice("format", format, kTexelFormats);
    r.numbers("height", height, "width", width);
    const int bytes[] = {1, 4, 8};  // per texel
    r.array("texels", texels, bytes[format] * int64_t(height) * width);
  }
};

void bind_baked(nb::module_& m) {
  nb::class_<AtlasTexture>(m, "AtlasTexture").def("__init__", [](AtlasTexture* to, const nb::kwargs& kwargs) {
    const Device host = {nb::device::cpu::value, "the CPU", false};
    Reader r("AtlasTexture", kwargs, host);
    const Texels t = read<Texels>(r);
    new (to) AtlasTexture(TexelFormat(t.format), t.height, t.width, t.texels);
  });
  bind_operation(m, "halve_texels_uint8", &halve_texels<uint8_t>);
  bind_operation(m, "halve_texels_half", &halve_texels<float>);
  m.def("draws_bc7", &draws_bc7, "True where the current device draws BC7 blocks; tried once.");
  bind_class<BakedScene>(m, "BakedScene", kCard, "A baked scene as the kernels read it.");
  bind_operation(m, "baked_frame", &baked_frame);
  m.def(
      "baked_memory",
      [](int64_t surfels, int views, int width, int height, int slots, int64_t capacity, bool normals) {
        return baked_memory(surfels, {views, width, height, nullptr, nullptr}, slots, capacity, normals);
      },
      "surfels"_a, "views"_a, "width"_a, "height"_a, "slots"_a, "capacity"_a, "normals"_a,
      "Bytes of working memory of a frame.");
  m.attr("MOST_ROWS") = kMostRows;
  m.attr("MOST_PAIRS") = kMostPairs;
}

void bind_all(nb::module_& m) {
  m.def("device_problem", &device_problem, "device"_a,
        "Reason why the kernels cannot run on a CUDA device, and the remedy; empty when they can.");
  bind_class<Pairs>(m, "Pairs", kCard, "Index of a fragment list (csrc/cuda/fragment_list.h).")
      .def_prop_ro("pairs", [](const Held<Pairs>& p) { return p.pairs; })
      .def_prop_ro("fragments", [](const Held<Pairs>& p) { return p.fragments; });
  bind_operations<float>(m);
  bind_operations<double>(m);
  bind_operation(m, "masked_counts", &masked_counts);
  bind_operation(m, "select_fragments", &select_fragments);
  bind_baked(m);
  m.attr("TILE_WARPS") = kTileWarps;
  m.attr("TRACE_SUMS") = kTraceSums;
  m.def("training_pairs_workspace", &training_pairs_workspace, "pairs"_a, "width"_a, "height"_a, "alpha"_a, "wide"_a);
  m.attr("MLP_WORK") = int64_t(kMostBlocks) * kMlpWeights;
  m.def("exact_size", &exact_size, "entries"_a, "Numbers of exact_work, int64.");
}
}  // namespace
}  // namespace bt::cuda

#if defined(BITYMI_EMULATED)
NB_MODULE(_emulated, m) {
  m.doc() = "The CUDA kernels, thread by thread on the host: for tests.";
  m.def("set_seed", &bt::emulator::set_seed, nanobind::arg("seed"),
        "Seed of the order in which blocks and their threads take turns.");
  m.def("stale_numbers", &bt::emulator::stale_numbers, "Threads that read another block's values in shared memory.");
  m.def("open_barrier", &bt::emulator::open_barrier, "A kernel whose threads wait for one that does not come.");
  m.def("read_float4", &bt::emulator::read_float4, nanobind::arg("offset"), "A kernel that may read misaligned.");
#else
NB_MODULE(_cuda, m) {
  m.doc() = "CUDA kernels: see bitymi_ns.ops for their meaning.";
#endif
  bt::cuda::bind_all(m);
}
