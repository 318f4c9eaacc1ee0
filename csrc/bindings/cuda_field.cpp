// The residual field: at points, at fragments and at texels.
#include <nanobind/stl/tuple.h>

#include "bindings/cuda.h"
#include "cuda/field.h"

namespace bt::cuda {
namespace {

// The kernels' view of the field's parameters; keeps them alive.
template <class S>
struct Field {
  FieldArrays<S> arrays;
  Array<const S> table, w1, w2, w3;
  Field(Array<const S> table_, Array<const S> w1_, Array<const S> w2_, Array<const S> w3_, int levels, int log2_size,
        int min_resolution, bool contract, std::tuple<double, double, double> mid, double half)
      : table(table_), w1(w1_), w2(w2_), w3(w3_) {
    if (levels < 1 || levels > kMaxLevels || log2_size < 0 || log2_size > 28)
      throw std::invalid_argument("a field has 1 to 4 levels and at most 2^28 entries a level");
    const int64_t inputs = levels * kFeatures;
    arrays = {levels,
              log2_size,
              min_resolution,
              contract,
              {S(std::get<0>(mid)), S(std::get<1>(mid)), S(std::get<2>(mid))},
              S(half),
              rows(table, entries(levels, log2_size), "table"),
              data(w1, inputs * kWidth, "w1"),
              data(w2, kWidth * kWidth, "w2"),
              data(w3, kWidth * 3, "w3")};
  }
  static int64_t entries(int levels, int log2_size) { return (int64_t(levels) << log2_size) * kFeatures; }
  int64_t entries() const { return entries(arrays.levels, arrays.log2_size); }
  FieldGradients<S> gradients(const Array<S>& table_, const Array<S>& w1_, const Array<S>& w2_,
                              const Array<S>& w3_) const {
    rows(Array<const S>(table_), entries(), "dtable");
    return {table_.data(), data(w1_, arrays.levels * kFeatures * kWidth, "dw1"), data(w2_, kWidth * kWidth, "dw2"),
            data(w3_, kWidth * 3, "dw3")};
  }
};

constexpr int64_t kRange = 8;  // numbers of ExactRange

template <class S>
FieldWork<S> work_of(const Array<S>& mlp, const Maybe<int64_t>& exact, int64_t exact_size) {
  return {data(mlp, int64_t(kMostBlocks) * kMlpWeights, "mlp_work"), data_or_null(exact, exact_size, "exact_work")};
}

template <class S>
void bind(nb::module_& m, const char* suffix) {
  const auto name = [&](const char* base) { return std::string(base) + suffix; };
  using In = Array<const S>;
  using Out = Array<S>;
  using Ints = Array<int32_t>;

  nb::class_<Field<S>>(m, name("Field").c_str())
      .def(nb::init<In, In, In, In, int, int, int, bool, std::tuple<double, double, double>, double>(),
           "table"_a.noconvert(), "w1"_a.noconvert(), "w2"_a.noconvert(), "w3"_a.noconvert(), "levels"_a, "log2_size"_a,
           "min_resolution"_a, "contract"_a, "mid"_a, "half"_a);
  m.def(
      name("field_forward").c_str(),
      [](const Field<S>& field, In x, Out rho, uintptr_t stream) {
        const int64_t n = int64_t(x.size()) / 3;
        field_forward(n, field.arrays, x.data(), data(rho, 3 * n, "rho"), stream_of(stream));
      },
      "field"_a, "x"_a.noconvert(), "rho"_a.noconvert(), "stream"_a = 0);
  m.def(
      name("field_backward").c_str(),
      [](const Field<S>& field, In x, In drho, Out dtable, Out dw1, Out dw2, Out dw3, Maybe<S> dx, Out mlp_work,
         Maybe<int64_t> exact_work, uintptr_t stream) {
        const int64_t n = int64_t(x.size()) / 3;
        field_backward(n, field.arrays, x.data(), data(drho, 3 * n, "drho"), field.gradients(dtable, dw1, dw2, dw3),
                       data_or_null(dx, 3 * n, "dx"), work_of(mlp_work, exact_work, field.entries() + kRange),
                       stream_of(stream));
      },
      "field"_a, "x"_a.noconvert(), "drho"_a.noconvert(), "dtable"_a.noconvert(), "dw1"_a.noconvert(),
      "dw2"_a.noconvert(), "dw3"_a.noconvert(), "dx"_a.noconvert().none(), "mlp_work"_a.noconvert(),
      "exact_work"_a.noconvert().none(), "stream"_a = 0);

  m.def(
      name("shade_forward").c_str(),
      [](Ints surfel, Ints pixel, Out weight, Out uv, Out depth, Out sigma, double bound, In base, In frames,
         const Field<S>* field, Out colors, uintptr_t stream) {
        const int64_t count = int64_t(surfel.size()), n = int64_t(base.size()) / 3;
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        shade_forward(f, S(bound), base.data(), data(frames, n * kFrame, "frames"), field ? &field->arrays : nullptr,
                      data(colors, 3 * count, "colors"), stream_of(stream));
      },
      "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(),
      "sigma"_a.noconvert(), "bound"_a, "base"_a.noconvert(), "frames"_a.noconvert(), "field"_a.none(),
      "colors"_a.noconvert(), "stream"_a = 0);
  m.def(
      name("shade_backward").c_str(),
      [](Array<const int64_t>, Ints surfel, Ints pixel, Out weight, Out uv, Out depth, Out sigma, double bound, In base,
         In frames, const Field<S>* field, In colors, In dcolors, Out dbase, Maybe<S> dtable, Maybe<S> dw1,
         Maybe<S> dw2, Maybe<S> dw3, Maybe<S> duv, Maybe<S> dframes, Maybe<S> mlp_work, Maybe<int64_t> exact_work,
         uintptr_t stream) {
        const int64_t count = int64_t(surfel.size()), n = int64_t(base.size()) / 3;
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        S *du = data_or_null(duv, 2 * count, "duv"), *df = data_or_null(dframes, n * kFrame, "dframes");
        FieldGradients<S> out = {};
        const bool learn = field && dtable && dw1 && dw2 && dw3;
        if (learn) out = field->gradients(*dtable, *dw1, *dw2, *dw3);
        if (learn && !mlp_work) throw std::invalid_argument("the field's gradients need mlp_work");
        if ((du != nullptr) != (df != nullptr) || (du && !learn))
          throw std::invalid_argument("duv and dframes come together, with the field's gradients");
        const int64_t size = (learn ? field->entries() : 0) + kRange + (df ? 3 + kFrame : 3) * n;
        const FieldWork<S> work = {
            data_or_null(mlp_work, int64_t(kMostBlocks) * kMlpWeights, "mlp_work"),
            data_or_null(exact_work, size, "exact_work"),
        };
        shade_backward(n, f, S(bound), base.data(), data(frames, n * kFrame, "frames"),
                       learn ? &field->arrays : nullptr, data(colors, 3 * count, "colors"),
                       data(dcolors, 3 * count, "dcolors"), data(dbase, 3 * n, "dbase"), learn ? &out : nullptr, du, df,
                       work, stream_of(stream));
      },
      "tile_start"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(),
      "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "bound"_a, "base"_a.noconvert(),
      "frames"_a.noconvert(), "field"_a.none(), "colors"_a.noconvert(), "dcolors"_a.noconvert(), "dbase"_a.noconvert(),
      "dtable"_a.noconvert().none(), "dw1"_a.noconvert().none(), "dw2"_a.noconvert().none(), "dw3"_a.noconvert().none(),
      "duv"_a.noconvert().none(), "dframes"_a.noconvert().none(), "mlp_work"_a.noconvert().none(),
      "exact_work"_a.noconvert().none(), "stream"_a = 0);

  m.def(
      name("bake_tiles").c_str(),
      [](const Field<S>& field, In frames, In extent, Array<const int32_t> tiles, Array<const int64_t> first,
         int64_t warps, int width, int height, Out pages, Array<int32_t> bad, uintptr_t stream) {
        const int64_t n = int64_t(extent.size());
        if (pages.size() % (size_t(width) * height * 3))
          throw std::invalid_argument("pages are not width x height x 3");
        bake_tiles(n, warps, field.arrays, data(frames, n * kFrame, "frames"), extent.data(),
                   data(tiles, 5 * n, "tiles"), data(first, n + 1, "first"), width, height, pages.data(),
                   data(bad, 1, "bad"), stream_of(stream));
      },
      "field"_a, "frames"_a.noconvert(), "extent"_a.noconvert(), "tiles"_a.noconvert(), "first"_a.noconvert(),
      "warps"_a, "width"_a, "height"_a, "pages"_a.noconvert(), "bad"_a.noconvert(), "stream"_a = 0);
}

}  // namespace

void bind_field(nb::module_& m) {
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
  m.attr("MLP_WORK") = int64_t(kMostBlocks) * kMlpWeights;
}

}  // namespace bt::cuda
