// The residual field: at points, at fragments and at texels.

#include "bindings/cuda.h"
#include "bindings/field.h"
#include "cuda/field.h"

namespace bt::cuda {
namespace {

template <class S>
using Field = FieldHandle<S, Where, 16>;  // kernels read the table 16 bytes at a time

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

  bind_field_class<Field<S>>(m, name("Field"));
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
                       data_or_null(dx, 3 * n, "dx"),
                       work_of(mlp_work, exact_work, exact_size(field.entries(), 0, false)), stream_of(stream));
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
        const int64_t size = exact_size(learn ? field->entries() : 0, n, df != nullptr);
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
  m.def("exact_size", &exact_size, "entries"_a, "surfels"_a, "frames"_a, "Numbers of exact_work, int64.");
}

}  // namespace bt::cuda
