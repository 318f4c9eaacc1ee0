// bitymi_ns._cpu: arrays in, arrays out. The caller allocates; shapes and dtypes are checked here, values in Python.
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#if defined(__GLIBC__) || __has_include(<malloc.h>)
#include <malloc.h>
#endif

#include "bindings/arrays.h"
#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {
using namespace nb::literals;

namespace {

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Maybe = std::optional<Array<T>>;

template <class S>
Pinhole<S> camera(const Array<const S>& viewmat, const Array<const S>& K) {
  const S *m = data(viewmat, 16, "viewmat"), *k = data(K, 9, "K");
  Pinhole<S> c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.R[3 * i + j] = m[4 * i + j];
    c.t[i] = m[4 * i + 3];
  }
  c.fx = k[0], c.fy = k[4], c.cx = k[2], c.cy = k[5];
  return c;
}

template <class S>
Surfels<S> surfels(int64_t n, const Array<const S>& means, const Array<const S>& quats,
                   const Array<const S>& log_scales, const Array<const S>& opacity_logits,
                   const Array<const S>& beta_raw) {
  return {n,
          data(means, 3 * n, "means"),
          data(quats, 4 * n, "quats"),
          data(log_scales, 2 * n, "log_scales"),
          opacity_logits.data(),
          data(beta_raw, n, "beta_raw")};
}

// What trace() found: tile boundaries and, until copied, the fragments.
template <class S>
struct Trace {
  Bins bins;
  FragmentList<S> list;
};

template <class S>
FragmentArrays<S> fragments(int64_t n, const Array<int32_t>& surfel, const Array<int32_t>& pixel,
                            const Array<S>& weight, const Array<S>& uv, const Array<S>& depth, const Array<S>& sigma) {
  return {data(surfel, n, "surfel"), data(pixel, n, "pixel"), data(weight, n, "weight"),
          data(uv, 2 * n, "uv"),     data(depth, n, "depth"), data(sigma, n, "sigma")};
}
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
// tile_start [tiles + 1] of f fragments
int64_t tiles_of(const Array<const int64_t>& tile_start, int64_t f) {
  const int64_t tiles = int64_t(tile_start.size()) - 1;
  if (tiles < 0 || tile_start.data()[0] != 0 || tile_start.data()[tiles] != f)
    throw std::invalid_argument("tile_start does not belong to these fragments");
  return tiles;
}

template <class S>
struct Field {
  FieldArrays<S> arrays;
  Array<const S> table, w1, w2, w3;  // keeps them alive
  Field(Array<const S> table_, Array<const S> w1_, Array<const S> w2_, Array<const S> w3_, int levels, int log2_size,
        int min_resolution, bool contract, std::tuple<double, double, double> mid, double half)
      : table(table_), w1(w1_), w2(w2_), w3(w3_) {
    if (levels < 1 || levels > 4 || log2_size < 4 || log2_size > 28)
      throw std::invalid_argument("a field has 1 to 4 levels and 2^4 to 2^28 entries a level");
    arrays = {levels,
              log2_size,
              min_resolution,
              contract,
              {S(std::get<0>(mid)), S(std::get<1>(mid)), S(std::get<2>(mid))},
              S(half),
              data(table, (int64_t(levels) << log2_size) * 4, "table"),
              data(w1, levels * 64, "w1"),
              data(w2, 256, "w2"),
              data(w3, 48, "w3")};
  }
  int64_t entries() const { return (int64_t(arrays.levels) << arrays.log2_size) * 4; }
};
template <class S>
FieldGradients<S> field_gradients(const Field<S>& field, const Array<S>& table, const Array<S>& w1, const Array<S>& w2,
                                  const Array<S>& w3) {
  return {data(table, field.entries(), "dtable"), data(w1, field.arrays.levels * 64, "dw1"), data(w2, 256, "dw2"),
          data(w3, 48, "dw3")};
}

int kind_number(const std::string& kind) {
  const char* names[] = {"sv", "sh", "sb", "sg"};
  for (int i = 0; i < 4; ++i)
    if (kind == names[i]) return i;
  throw std::invalid_argument("unknown view colour '" + kind + "'");
}

template <class S>
void bind(nb::module_& m, const char* suffix) {
  const auto name = [&](const char* base) { return std::string(base) + suffix; };
  using In = Array<const S>;
  using Out = Array<S>;
  using Ints = Array<int32_t>;
  using ConstInts = Array<const int32_t>;
  using Starts = Array<const int64_t>;

  m.def(
      name("project_forward").c_str(),
      [](In means, In quats, In log_scales, In opacity_logits, In beta_raw, In viewmat, In K, int width, int height,
         double near, bool prefilter, Out geom, Out frames, Out radii, Array<int32_t> broken) {
        const int64_t n = int64_t(opacity_logits.size());
        const Surfels<S> in = surfels<S>(n, means, quats, log_scales, opacity_logits, beta_raw);
        S *g = data(geom, n * kGeom, "geom"), *f = data(frames, n * kFrame, "frames");
        S* r = data(radii, 2 * n, "radii");
        const Pinhole<S> cam = camera<S>(viewmat, K);
        int32_t* count = data(broken, 1, "broken");
        nb::gil_scoped_release release;
        *count += int32_t(project_forward(cam, width, height, S(near), prefilter, in, g, f, r));
      },
      "means"_a.noconvert(), "quats"_a.noconvert(), "log_scales"_a.noconvert(), "opacity_logits"_a.noconvert(),
      "beta_raw"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a, "height"_a, "near"_a,
      "prefilter"_a, "geom"_a.noconvert(), "frames"_a.noconvert(), "radii"_a.noconvert(), "broken"_a.noconvert());

  m.def(
      name("project_backward").c_str(),
      [](In means, In quats, In log_scales, In opacity_logits, In beta_raw, In viewmat, In K, In geom, In dgeom,
         Maybe<const S> dframes, Out dmeans, Out dquats, Out dlog_scales, Out dopacity_logits, Out dbeta_raw) {
        const int64_t n = int64_t(opacity_logits.size());
        const Surfels<S> in = surfels<S>(n, means, quats, log_scales, opacity_logits, beta_raw);
        const SurfelGradients<S> out = {data(dmeans, 3 * n, "dmeans"), data(dquats, 4 * n, "dquats"),
                                        data(dlog_scales, 2 * n, "dlog_scales"),
                                        data(dopacity_logits, n, "dopacity_logits"), data(dbeta_raw, n, "dbeta_raw")};
        const S *g = data(geom, n * kGeom, "geom"), *dg = data(dgeom, n * kGeom, "dgeom");
        const S* df = data_or_null(dframes, n * kFrame, "dframes");
        const Pinhole<S> cam = camera<S>(viewmat, K);
        nb::gil_scoped_release release;
        project_backward(cam, in, g, dg, df, out);
      },
      "means"_a.noconvert(), "quats"_a.noconvert(), "log_scales"_a.noconvert(), "opacity_logits"_a.noconvert(),
      "beta_raw"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "geom"_a.noconvert(), "dgeom"_a.noconvert(),
      "dframes"_a.noconvert().none(), "dmeans"_a.noconvert(), "dquats"_a.noconvert(), "dlog_scales"_a.noconvert(),
      "dopacity_logits"_a.noconvert(), "dbeta_raw"_a.noconvert());

  nb::class_<Trace<S>>(m, name("Trace").c_str())
      .def(nb::init<>())
      .def(
          "run",
          [](Trace<S>& t, In geom, In radii, int width, int height, double near, bool fragments_too) {
            const int64_t n = int64_t(radii.size()) / 2;
            const S *g = data(geom, n * kGeom, "geom"), *r = radii.data();
            nb::gil_scoped_release release;
            bin(n, g, r, width, height, t.bins);
            if (fragments_too) trace_forward(g, r, S(near), t.bins, width, height, t.list);
            return t.list.total;
          },
          "geom"_a.noconvert(), "radii"_a.noconvert(), "width"_a, "height"_a, "near"_a, "fragments"_a = true)
      .def_prop_ro("tiles", [](const Trace<S>& t) { return int64_t(t.bins.tiles_x) * t.bins.tiles_y; })
      .def_prop_ro("pairs", [](const Trace<S>& t) { return int64_t(t.bins.surfels.size()); })
      .def(
          "copy",
          [](const Trace<S>& t, Array<int64_t> tile_start, Ints surfel, Ints pixel, Out weight, Out uv, Out depth,
             Out sigma) {
            const int64_t n = t.list.total;
            int64_t* to = data(tile_start, int64_t(t.list.tile_start.size()), "tile_start");
            const FragmentArrays<S> f = fragments<S>(n, surfel, pixel, weight, uv, depth, sigma);
            nb::gil_scoped_release release;
            std::copy(t.list.tile_start.begin(), t.list.tile_start.end(), to);
            trace_copy(t.list, f);
          },
          "tile_start"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(),
          "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert())
      .def(
          "baked",
          [](const Trace<S>& t, In geom, In radii, int width, int height, double near, double weight_bound,
             double transmittance_min, bool maps, In base, const Patches& patches, double offset, double scale,
             Array<const float> extent, Array<const float> mean_residual, Out image, Maybe<int32_t> overdraw) {
            const int64_t n = int64_t(radii.size()) / 2, pixels = int64_t(width) * height;
            if (int64_t(patches.first.size()) != n) throw std::invalid_argument("the patches belong to other surfels");
            const Atlas atlas = {patches,
                                 float(offset),
                                 float(scale),
                                 data(extent, n, "extent"),
                                 float(weight_bound),
                                 float(transmittance_min),
                                 data(mean_residual, 3 * n, "mean_residual")};
            const S *g = data(geom, n * kGeom, "geom"), *r = radii.data(), *b = data(base, 3 * n, "base");
            S* out = data(image, pixels * (maps ? kMapChannels : kBakedChannels), "image");
            int32_t* o = data_or_null(overdraw, pixels, "overdraw");
            nb::gil_scoped_release release;
            baked_forward(g, r, S(near), t.bins, width, height, maps, b, atlas, out, o);
          },
          "geom"_a.noconvert(), "radii"_a.noconvert(), "width"_a, "height"_a, "near"_a, "weight_bound"_a,
          "transmittance_min"_a, "maps"_a, "base"_a.noconvert(), "patches"_a, "offset"_a, "scale"_a,
          "extent"_a.noconvert(), "mean_residual"_a.noconvert(), "image"_a.noconvert(),
          "overdraw"_a.noconvert().none());

  m.def(
      name("trace_backward").c_str(),
      [](In geom, double near, double rim, int width, Starts tile_start, Ints surfel, Ints pixel, Out weight, Out uv,
         Out depth, Out sigma, Maybe<const S> dweight, Maybe<const S> duv, Maybe<const S> ddepth, Out dgeom,
         Out absgrad) {
        const int64_t n = int64_t(geom.size()) / kGeom, count = int64_t(surfel.size());
        const int64_t tiles = tiles_of(tile_start, count);
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        const S *dw = data_or_null(dweight, count, "dweight"), *du = data_or_null(duv, 2 * count, "duv");
        const S* dz = data_or_null(ddepth, count, "ddepth");
        S *dg = data(dgeom, n * kGeom, "dgeom"), *ag = data(absgrad, 2 * n, "absgrad");
        nb::gil_scoped_release release;
        trace_backward(n, geom.data(), S(near), S(rim), width, tile_start.data(), tiles, f, dw, du, dz, dg, ag);
      },
      "geom"_a.noconvert(), "near"_a, "rim"_a, "width"_a, "tile_start"_a.noconvert(), "surfel"_a.noconvert(),
      "pixel"_a.noconvert(), "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(),
      "dweight"_a.noconvert().none(), "duv"_a.noconvert().none(), "ddepth"_a.noconvert().none(), "dgeom"_a.noconvert(),
      "absgrad"_a.noconvert());

  m.def(
      name("composite_forward").c_str(),
      [](bool maps, In geom, Starts tile_start, Ints surfel, Ints pixel, Out weight, Out uv, Out depth, Out sigma,
         In colors, Out image) {
        const int64_t count = int64_t(surfel.size()), tiles = tiles_of(tile_start, count);
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        const S* c = data(colors, 3 * count, "colors");
        const int64_t pixels = int64_t(image.size()) / (maps ? kMapChannels : kImageChannels);
        nb::gil_scoped_release release;
        composite_forward(pixels, maps, geom.data(), tile_start.data(), tiles, f, c, image.data());
      },
      "maps"_a, "geom"_a.noconvert(), "tile_start"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(),
      "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "colors"_a.noconvert(),
      "image"_a.noconvert());

  m.def(
      name("composite_backward").c_str(),
      [](bool maps, In geom, Starts tile_start, Ints surfel, Ints pixel, Out weight, Out uv, Out depth, Out sigma,
         In colors, In dimage, Out dweight, Out dcolors, Maybe<S> ddepth, Out dgeom) {
        const int64_t n = int64_t(geom.size()) / kGeom, count = int64_t(surfel.size());
        const int64_t tiles = tiles_of(tile_start, count);
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        const S* c = data(colors, 3 * count, "colors");
        S *dw = data(dweight, count, "dweight"), *dc = data(dcolors, 3 * count, "dcolors");
        S *dz = data_or_null(ddepth, count, "ddepth"), *dg = data(dgeom, n * kGeom, "dgeom");
        if (maps && !dz) throw std::invalid_argument("maps need ddepth");
        nb::gil_scoped_release release;
        composite_backward(n, maps, geom.data(), tile_start.data(), tiles, f, c, dimage.data(), dw, dc, dz, dg);
      },
      "maps"_a, "geom"_a.noconvert(), "tile_start"_a.noconvert(), "surfel"_a.noconvert(), "pixel"_a.noconvert(),
      "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "colors"_a.noconvert(),
      "dimage"_a.noconvert(), "dweight"_a.noconvert(), "dcolors"_a.noconvert(), "ddepth"_a.noconvert().none(),
      "dgeom"_a.noconvert());

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

  nb::class_<Field<S>>(m, name("Field").c_str())
      .def(nb::init<In, In, In, In, int, int, int, bool, std::tuple<double, double, double>, double>(),
           "table"_a.noconvert(), "w1"_a.noconvert(), "w2"_a.noconvert(), "w3"_a.noconvert(), "levels"_a, "log2_size"_a,
           "min_resolution"_a, "contract"_a, "mid"_a, "half"_a);
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
        const FieldGradients<S> out = field_gradients(field, dtable, dw1, dw2, dw3);
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
        if (learn) out = field_gradients(*field, *dtable, *dw1, *dw2, *dw3);
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

NB_MODULE(_cpu, m) {
#if defined(__GLIBC__)
  // Every view allocates and frees the same tens of megabytes. Given back to the system in between, they cost more in
  // page faults than what is computed in them.
  mallopt(M_MMAP_THRESHOLD, 32 << 20);
  mallopt(M_TRIM_THRESHOLD, 1 << 30);
  mallopt(M_TOP_PAD, 64 << 20);
#endif
  wait_without_spinning();
  nb::set_leak_warnings(false);  // tracers keep their memory until the process ends
  m.doc() = "CPU kernels: see bitymi_ns.ops for their meaning.";
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
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
  m.def(
      "masked_counts",
      [](Array<const int32_t> surfel, Array<const int32_t> pixel, Array<const uint8_t> mask, Array<int32_t> counts) {
        const int64_t n = int64_t(surfel.size());
        masked_counts(n, surfel.data(), data(pixel, n, "pixel"), mask.data(), counts.data());
      },
      "surfel"_a.noconvert(), "pixel"_a.noconvert(), "mask"_a.noconvert(), "counts"_a.noconvert());
  m.def("set_num_threads", &set_num_threads, "n"_a, "Threads of the kernels; 0 = as many as there are cores.");
  m.def("num_threads", &num_threads);
}

}  // namespace bt
