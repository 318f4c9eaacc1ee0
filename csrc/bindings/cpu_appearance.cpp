// View colours, the residual field at points and at fragments, texels, and SSIM.
#include <nanobind/stl/string.h>

#include "bindings/cpu.h"
#include "bindings/field.h"

namespace bt {
namespace {

template <class S>
TexelFragments<S> texel_fragments(const Array<const int32_t>& surfel, const Array<const int32_t>& pixel,
                                  const Array<const S>& weight, const Array<const S>& uv) {
  const int64_t n = int64_t(surfel.size());
  return {n, surfel.data(), data(pixel, n, "pixel"), data(weight, n, "weight"), data(uv, 2 * n, "uv")};
}
// span [n, 2] of lean view colours lies within the terms, which have `size` numbers
void check_spans(const int32_t* span, int64_t n, int64_t size, int width) {
  for (int64_t i = 0; i < n; ++i) {
    const int64_t first = span[2 * i], count = span[2 * i + 1];
    if (first < 0 || count < 0 || count > kMaxTerms || (first + count) * width > size)
      throw std::invalid_argument("the terms of surfel " + std::to_string(i) + "'s view colour are not there");
  }
}

template <class S>
using Field = FieldHandle<S, nb::device::cpu, sizeof(S)>;

template <class S>
void bind(nb::module_& m, const char* suffix) {
  const auto name = [&](const char* base) { return std::string(base) + suffix; };
  using In = Array<const S>;
  using Out = Array<S>;
  using Ints = Array<int32_t>;
  using ConstInts = Array<const int32_t>;
  using Starts = Array<const int64_t>;

  m.def(
      name("view_color_forward").c_str(),
      [](const std::string& kind, int terms, In a, In b, Maybe<const S> c, In means, Array<const double> center,
         Array<const uint8_t> active, Out out) {
        const int64_t n = int64_t(active.size());
        const ViewColorArrays<const S> p = {kind_number(kind), terms, a.data(), b.data(), c ? c->data() : nullptr};
        const S* x = data(means, 3 * n, "means");
        const double* o = data(center, 3, "center");
        S* to = data(out, 3 * n, "out");
        nb::gil_scoped_release release;
        view_color_forward(n, p, x, o, active.data(), to);
      },
      "kind"_a, "terms"_a, "a"_a.noconvert(), "b"_a.noconvert(), "c"_a.noconvert().none(), "means"_a.noconvert(),
      "center"_a.noconvert(), "active"_a.noconvert(), "out"_a.noconvert());

  m.def(
      name("lean_color").c_str(),
      [](const std::string& kind, In base, Array<const int32_t> span, In terms, In means, Array<const double> center,
         Array<const uint8_t> active, Out out) {
        const int64_t n = int64_t(active.size());
        const int number = kind_number(kind);
        const LeanColors<S> p = {number, data(base, 3 * n, "base"), terms.data(), data(span, 2 * n, "span")};
        check_spans(p.span, n, int64_t(terms.size()), lean_width(number));
        const S* x = data(means, 3 * n, "means");
        const double* o = data(center, 3, "center");
        S* to = data(out, 3 * n, "out");
        nb::gil_scoped_release release;
        lean_color(n, p, x, o, active.data(), to);
      },
      "kind"_a, "base"_a.noconvert(), "span"_a.noconvert(), "terms"_a.noconvert(), "means"_a.noconvert(),
      "center"_a.noconvert(), "active"_a.noconvert(), "out"_a.noconvert());

  m.def(
      name("view_color_backward").c_str(),
      [](const std::string& kind, int terms, In a, In b, Maybe<const S> c, In means, Array<const double> center,
         Array<const uint8_t> active, In dout, Out da, Out db, Maybe<S> dc, Out dmeans) {
        const int64_t n = int64_t(active.size());
        const ViewColorArrays<const S> p = {kind_number(kind), terms, a.data(), b.data(), c ? c->data() : nullptr};
        const ViewColorArrays<S> d = {p.kind, terms, da.data(), db.data(), dc ? dc->data() : nullptr};
        const S* x = data(means, 3 * n, "means");
        const double* o = data(center, 3, "center");
        const S* g = data(dout, 3 * n, "dout");
        S* dx = data(dmeans, 3 * n, "dmeans");
        nb::gil_scoped_release release;
        view_color_backward(n, p, x, o, active.data(), g, d, dx);
      },
      "kind"_a, "terms"_a, "a"_a.noconvert(), "b"_a.noconvert(), "c"_a.noconvert().none(), "means"_a.noconvert(),
      "center"_a.noconvert(), "active"_a.noconvert(), "dout"_a.noconvert(), "da"_a.noconvert(), "db"_a.noconvert(),
      "dc"_a.noconvert().none(), "dmeans"_a.noconvert());

  bind_field_class<Field<S>>(m, name("Field"));
  m.def(
      name("field_forward").c_str(),
      [](const Field<S>& field, In x, Out rho) {
        const int64_t n = int64_t(x.size()) / 3;
        S* to = data(rho, 3 * n, "rho");
        nb::gil_scoped_release release;
        field_forward(n, field.arrays, x.data(), to);
      },
      "field"_a, "x"_a.noconvert(), "rho"_a.noconvert());
  m.def(
      name("field_backward").c_str(),
      [](const Field<S>& field, In x, In drho, Out dtable, Out dw1, Out dw2, Out dw3, Maybe<S> dx) {
        const int64_t n = int64_t(x.size()) / 3;
        const S* g = data(drho, 3 * n, "drho");
        S* to = data_or_null(dx, 3 * n, "dx");
        const FieldGradients<S> out = field.gradients(dtable, dw1, dw2, dw3);
        nb::gil_scoped_release release;
        field_backward(n, field.arrays, x.data(), g, out, to);
      },
      "field"_a, "x"_a.noconvert(), "drho"_a.noconvert(), "dtable"_a.noconvert(), "dw1"_a.noconvert(),
      "dw2"_a.noconvert(), "dw3"_a.noconvert(), "dx"_a.noconvert().none());

  m.def(
      name("shade_forward").c_str(),
      [](Ints surfel, Ints pixel, Out weight, Out uv, Out depth, Out sigma, double bound, In base, In frames,
         const Field<S>* field, Out colors) {
        const int64_t count = int64_t(surfel.size());
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        S* to = data(colors, 3 * count, "colors");
        nb::gil_scoped_release release;
        shade_forward(count, f, S(bound), base.data(), frames.data(), field ? &field->arrays : nullptr, to);
      },
      "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(),
      "sigma"_a.noconvert(), "bound"_a, "base"_a.noconvert(), "frames"_a.noconvert(), "field"_a.none(),
      "colors"_a.noconvert());

  m.def(
      name("shade_backward").c_str(),
      [](Starts tile_start, Ints surfel, Ints pixel, Out weight, Out uv, Out depth, Out sigma, double bound, In base,
         In frames, const Field<S>* field, In colors, In dcolors, Out dbase, Maybe<S> dtable, Maybe<S> dw1,
         Maybe<S> dw2, Maybe<S> dw3, Maybe<S> duv, Maybe<S> dframes) {
        const int64_t n = int64_t(base.size()) / 3, count = int64_t(surfel.size());
        const int64_t tiles = tiles_of(tile_start, count);
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        const S *c = data(colors, 3 * count, "colors"), *dc = data(dcolors, 3 * count, "dcolors");
        S *db = data(dbase, 3 * n, "dbase"), *du = data_or_null(duv, 2 * count, "duv");
        S* df = data_or_null(dframes, n * kFrame, "dframes");
        FieldGradients<S> out = {};
        const bool learn = field && dtable && dw1 && dw2 && dw3;
        if (learn) out = field->gradients(*dtable, *dw1, *dw2, *dw3);
        if ((du != nullptr) != (df != nullptr) || (du && !learn))
          throw std::invalid_argument("duv and dframes come together, with the field's gradients");
        nb::gil_scoped_release release;
        shade_backward(n, tile_start.data(), tiles, f, S(bound), base.data(), frames.data(),
                       field ? &field->arrays : nullptr, c, dc, db, learn ? &out : nullptr, du, df);
      },
      "tile_start"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(),
      "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "bound"_a, "base"_a.noconvert(),
      "frames"_a.noconvert(), "field"_a.none(), "colors"_a.noconvert(), "dcolors"_a.noconvert(), "dbase"_a.noconvert(),
      "dtable"_a.noconvert().none(), "dw1"_a.noconvert().none(), "dw2"_a.noconvert().none(), "dw3"_a.noconvert().none(),
      "duv"_a.noconvert().none(), "dframes"_a.noconvert().none());

  m.def(
      name("texel_image_forward").c_str(),
      [](Starts tile_start, ConstInts surfel, ConstInts pixel, In weight, In uv, double bound, In base, Starts first,
         ConstInts size, In extent, In texels, Out image) {
        const int64_t n = int64_t(first.size()), count = int64_t(surfel.size());
        const int64_t tiles = tiles_of(tile_start, count), pixels = int64_t(image.size()) / 3;
        const TexelFragments<S> f = texel_fragments<S>(surfel, pixel, weight, uv);
        const TexelTiles<S> table = {first.data(), data(size, 2 * n, "size"), data(extent, n, "extent")};
        const S* b = data(base, 3 * n, "base");
        nb::gil_scoped_release release;
        texel_image_forward(pixels, tile_start.data(), tiles, f, S(bound), b, table, texels.data(), image.data());
      },
      "tile_start"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(),
      "uv"_a.noconvert(), "bound"_a, "base"_a.noconvert(), "first"_a.noconvert(), "size"_a.noconvert(),
      "extent"_a.noconvert(), "texels"_a.noconvert(), "image"_a.noconvert());

  m.def(
      name("texel_image_backward").c_str(),
      [](Starts run_start, Starts order, ConstInts surfel, ConstInts pixel, In weight, In uv, double bound, In base,
         Starts first, ConstInts size, In extent, In texels, In dimage, Maybe<S> dtexels, Maybe<S> dbase) {
        const int64_t n = int64_t(first.size()), count = int64_t(surfel.size());
        const int64_t runs = tiles_of(run_start, count);
        const TexelFragments<S> f = texel_fragments<S>(surfel, pixel, weight, uv);
        const TexelTiles<S> table = {first.data(), data(size, 2 * n, "size"), data(extent, n, "extent")};
        const int64_t* o = data(order, runs, "order");
        const S* b = data(base, 3 * n, "base");
        S* dt = data_or_null(dtexels, int64_t(texels.size()), "dtexels");
        S* db = data_or_null(dbase, 3 * n, "dbase");
        nb::gil_scoped_release release;
        texel_image_backward(n, run_start.data(), o, runs, f, S(bound), b, table, texels.data(), dimage.data(), dt, db);
      },
      "run_start"_a.noconvert(), "order"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(),
      "weight"_a.noconvert(), "uv"_a.noconvert(), "bound"_a, "base"_a.noconvert(), "first"_a.noconvert(),
      "size"_a.noconvert(), "extent"_a.noconvert(), "texels"_a.noconvert(), "dimage"_a.noconvert(),
      "dtexels"_a.noconvert().none(), "dbase"_a.noconvert().none());

  m.def(
      name("ssim").c_str(),
      [](In a, In b, int height, int width, int channels, Maybe<S> da) {
        const int64_t size = int64_t(height) * width * channels;
        const S *p = data(a, size, "a"), *q = data(b, size, "b");
        S* g = data_or_null(da, size, "da");
        nb::gil_scoped_release release;
        return double(ssim(height, width, channels, p, q, g));
      },
      "a"_a.noconvert(), "b"_a.noconvert(), "height"_a, "width"_a, "channels"_a, "da"_a.noconvert().none());
}

}  // namespace

void bind_appearance(nb::module_& m) {
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
}

}  // namespace bt
