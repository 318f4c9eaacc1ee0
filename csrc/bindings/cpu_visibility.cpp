// Projection, fragments, blending, and the baked renderer, which shares their tile lists.
#include "bindings/cpu.h"

namespace bt {
namespace {

// What trace() found: tile boundaries and, until copied, the fragments.
template <class S>
struct Trace {
  Trace() = default;
  Trace(const Trace&) = delete;  // nanobind would else offer copies
  Bins bins;
  FragmentList<S> list;
};

template <class S>
void bind(nb::module_& m, const char* suffix) {
  const auto name = [&](const char* base) { return std::string(base) + suffix; };
  using In = Array<const S>;
  using Out = Array<S>;
  using Ints = Array<int32_t>;
  using Starts = Array<const int64_t>;

  m.def(
      name("project_forward").c_str(),
      [](In means, In quats, In log_scales, In opacity_logits, In beta_raw, In viewmat, In K, int width, int height,
         double near, bool through_pixel, Out geom, Out frames, Out radii, Array<int32_t> broken) {
        const Surfels<S> in = surfels(means, quats, log_scales, opacity_logits, beta_raw);
        const int64_t n = in.n;
        S *g = data(geom, n * kGeom, "geom"), *f = data(frames, n * kFrame, "frames");
        S* r = data(radii, 2 * n, "radii");
        const Pinhole<S> cam = pinhole(data(viewmat, 16, "viewmat"), data(K, 9, "K"));
        int32_t* count = data(broken, 1, "broken");
        nb::gil_scoped_release release;
        *count += int32_t(project_forward(through_pixel, cam, width, height, S(near), in, g, f, r));
      },
      "means"_a.noconvert(), "quats"_a.noconvert(), "log_scales"_a.noconvert(), "opacity_logits"_a.noconvert(),
      "beta_raw"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a, "height"_a, "near"_a,
      "through_pixel"_a, "geom"_a.noconvert(), "frames"_a.noconvert(), "radii"_a.noconvert(), "broken"_a.noconvert());

  m.def(
      name("project_backward").c_str(),
      [](In means, In quats, In log_scales, In opacity_logits, In beta_raw, In viewmat, In K, In geom, In dgeom,
         Maybe<const S> dframes, Out dmeans, Out dquats, Out dlog_scales, Out dopacity_logits, Out dbeta_raw) {
        const Surfels<S> in = surfels(means, quats, log_scales, opacity_logits, beta_raw);
        const int64_t n = in.n;
        const SurfelGradients<S> out = surfel_gradients(n, dmeans, dquats, dlog_scales, dopacity_logits, dbeta_raw);
        const S *g = data(geom, n * kGeom, "geom"), *dg = data(dgeom, n * kGeom, "dgeom");
        const S* df = data_or_null(dframes, n * kFrame, "dframes");
        const Pinhole<S> cam = pinhole(data(viewmat, 16, "viewmat"), data(K, 9, "K"));
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
          [](Trace<S>& t, In geom, In radii, int width, int height, double near, bool through_pixel, int64_t most,
             bool fragments_too) {
            const int64_t n = int64_t(radii.size()) / 2;
            const S *g = data(geom, n * kGeom, "geom"), *r = radii.data();
            nb::gil_scoped_release release;
            bin(through_pixel, n, g, r, width, height, t.bins);
            if (fragments_too) trace_forward(through_pixel, g, r, S(near), t.bins, width, height, most, t.list);
            return t.list.total;
          },
          "geom"_a.noconvert(), "radii"_a.noconvert(), "width"_a, "height"_a, "near"_a, "through_pixel"_a, "most"_a = 0,
          "fragments"_a = true)
      .def_prop_ro("tiles", [](const Trace<S>& t) { return int64_t(t.bins.tiles_x) * t.bins.tiles_y; })
      .def_prop_ro("pairs", [](const Trace<S>& t) { return int64_t(t.bins.surfels.size()); })
      .def(
          "copy",
          [](Trace<S>& t, Array<int64_t> tile_start, Ints surfel, Ints pixel, Out weight, Out uv, Out depth,
             Out sigma) {
            const int64_t n = t.list.total;
            if (n && t.list.blocks.empty()) throw std::logic_error("the fragments were counted only, or copied before");
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
          [](const Trace<S>& t, In geom, In radii, int width, int height, double near, bool through_pixel,
             double weight_bound, double transmittance_min, bool maps, In base, const Patches& patches, double offset,
             double scale, Array<const float> extent, Array<const float> mean_residual, Out image,
             Maybe<int32_t> overdraw) {
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
            baked_forward(through_pixel, g, r, S(near), t.bins, width, height, maps, b, atlas, out, o);
          },
          "geom"_a.noconvert(), "radii"_a.noconvert(), "width"_a, "height"_a, "near"_a, "through_pixel"_a,
          "weight_bound"_a, "transmittance_min"_a, "maps"_a, "base"_a.noconvert(), "patches"_a, "offset"_a, "scale"_a,
          "extent"_a.noconvert(), "mean_residual"_a.noconvert(), "image"_a.noconvert(),
          "overdraw"_a.noconvert().none());

  m.def(
      name("trace_backward").c_str(),
      [](In geom, double near, bool through_pixel, double rim, int width, Starts tile_start, Ints surfel, Ints pixel,
         Out weight, Out uv, Out depth, Out sigma, Maybe<const S> dweight, Maybe<const S> duv, Maybe<const S> ddepth,
         Out dgeom, Out absgrad) {
        const int64_t n = int64_t(geom.size()) / kGeom, count = int64_t(surfel.size());
        const int64_t tiles = tiles_of(tile_start, count);
        const FragmentArrays<S> f = fragments<S>(count, surfel, pixel, weight, uv, depth, sigma);
        const S *dw = data_or_null(dweight, count, "dweight"), *du = data_or_null(duv, 2 * count, "duv");
        const S* dz = data_or_null(ddepth, count, "ddepth");
        S *dg = data(dgeom, n * kGeom, "dgeom"), *ag = data(absgrad, 2 * n, "absgrad");
        nb::gil_scoped_release release;
        trace_backward(through_pixel, n, geom.data(), S(near), S(rim), width, tile_start.data(), tiles, f, dw, du, dz,
                       dg, ag);
      },
      "geom"_a.noconvert(), "near"_a, "through_pixel"_a, "rim"_a, "width"_a, "tile_start"_a.noconvert(),
      "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(),
      "sigma"_a.noconvert(), "dweight"_a.noconvert().none(), "duv"_a.noconvert().none(), "ddepth"_a.noconvert().none(),
      "dgeom"_a.noconvert(), "absgrad"_a.noconvert());

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
}

}  // namespace

void bind_visibility(nb::module_& m) {
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
}

}  // namespace bt
