#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bindings/cuda.h"
#include "cuda/atlas_texture.h"
#include "cuda/baked.h"

namespace bt::cuda {
namespace {

using Floats = Array<const float>;
using MaybeFloats = Maybe<const float>;

template <class T>
T choice(const std::string& name, const std::vector<std::pair<const char*, T>>& choices) {
  for (const auto& [known, value] : choices)
    if (name == known) return value;
  throw std::invalid_argument("unknown name " + name);
}

struct Parameters {  // of a view colour, numbers per surfel
  int kind;
  int64_t a, b, c;
};
Parameters parameters(const std::string& kind, int64_t terms) {
  return choice<Parameters>(kind, {{"sv", {0, 3 * terms, terms, 3 * terms}},
                                   {"sh", {1, 3, 3 * (terms - 1), 0}},
                                   {"sb", {2, 3, 6 * terms, 0}},
                                   {"sg", {3, 3, 7 * terms, 0}}});
}

void frame(Floats means, Floats quats, Floats log_scales, Floats opacity_logits, Floats beta_raw,
           const std::string& kind, int terms, MaybeFloats a, MaybeFloats b, MaybeFloats c, MaybeFloats base,
           Maybe<const int32_t> span, MaybeFloats lean, Array<const int32_t> tiles, MaybeFloats extent,
           MaybeFloats mean_residual, Maybe<const int64_t> pages, double offset, double scale, double weight_bound,
           double near, bool through_pixel, double transmittance_min, Floats viewmats, Floats Ks, int width, int height,
           MaybeFloats background, Maybe<float> rgb, Maybe<float> alpha, Maybe<int32_t> packed, Maybe<float> beta,
           Maybe<float> depth, Maybe<float> normal, Maybe<int32_t> overdraw, int stages, Array<uint8_t> memory,
           int64_t capacity, uintptr_t stream) {
  BakedSurfels s = {};
  s.geometry = surfels(means, quats, log_scales, opacity_logits, beta_raw);
  const int64_t n = s.geometry.n;
  const Parameters p = parameters(kind, terms);
  const BakedViews views = {int(viewmats.size() / 16), width, height, viewmats.data(),
                            data(Ks, int64_t(viewmats.size() / 16) * 9, "Ks")};
  const int64_t pixels = int64_t(views.count) * width * height;
  s.kind = p.kind, s.terms = terms;
  if (base && span && lean) {
    s.lean = {p.kind, data_or_null(base, 3 * n, "base"), lean->data(), data_or_null(span, 2 * n, "span")};
  } else {
    if (!a || !b) throw std::invalid_argument("a view colour is missing");
    s.a = data_or_null(a, p.a * n, "a"), s.b = data_or_null(b, p.b * n, "b"), s.c = data_or_null(c, p.c * n, "c");
  }
  s.tiles = data(tiles, 5 * n, "tiles");
  s.extent = data_or_null(extent, n, "extent");
  s.mean_residual = data_or_null(mean_residual, 3 * n, "mean_residual");
  s.pages = pages ? reinterpret_cast<const uint64_t*>(pages->data()) : nullptr;
  s.offset = float(offset), s.scale = float(scale), s.weight_bound = float(weight_bound), s.near = float(near);
  s.through_pixel = through_pixel, s.transmittance_min = float(transmittance_min);
  BakedImages to = {};
  to.rgb = data_or_null(rgb, 3 * pixels, "rgb"), to.alpha = data_or_null(alpha, pixels, "alpha");
  to.packed = reinterpret_cast<uint32_t*>(data_or_null(packed, pixels, "packed"));
  to.beta = data_or_null(beta, pixels, "beta"), to.depth = data_or_null(depth, pixels, "depth");
  to.normal = data_or_null(normal, 3 * pixels, "normal"), to.overdraw = data_or_null(overdraw, pixels, "overdraw");
  to.background = data_or_null(background, 3, "background");
  baked_frame(s, views, to, stages, memory.data(), memory.size(), capacity, stream_of(stream));
}

}  // namespace

void bind_baked(nb::module_& m) {
  nb::class_<AtlasTexture>(m, "AtlasTexture")
      .def(
          "__init__",
          [](AtlasTexture* to, const std::string& format, int layers, int height, int width,
             nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu> texels) {
            const TexelFormat f = choice<TexelFormat>(
                format, {{"bc7", TexelFormat::kBc7}, {"uint8", TexelFormat::kUint8}, {"half", TexelFormat::kHalf}});
            const int64_t bytes = f == TexelFormat::kBc7 ? 1 : f == TexelFormat::kHalf ? 8 : 4;
            new (to) AtlasTexture(f, layers, height, width,
                                  data(texels, bytes * layers * int64_t(height) * width, "texels"));
          },
          "format"_a, "layers"_a, "height"_a, "width"_a, "texels"_a.noconvert())
      .def_prop_ro("handles", &AtlasTexture::handles);

  m.attr("MOST_ROWS") = kMostRows;
  m.attr("MOST_PAIRS") = kMostPairs;
  m.def(
      "baked_memory",
      [](int64_t surfels, int views, int width, int height, int64_t capacity, bool normals) {
        return baked_memory(surfels, {views, width, height, nullptr, nullptr}, capacity, normals);
      },
      "surfels"_a, "views"_a, "width"_a, "height"_a, "capacity"_a, "normals"_a, "Bytes of working memory of a frame.");
  m.def("baked_frame", &frame, "means"_a.noconvert(), "quats"_a.noconvert(), "log_scales"_a.noconvert(),
        "opacity_logits"_a.noconvert(), "beta_raw"_a.noconvert(), "kind"_a, "terms"_a, "a"_a.noconvert().none(),
        "b"_a.noconvert().none(), "c"_a.noconvert().none(), "base"_a.noconvert().none(), "span"_a.noconvert().none(),
        "lean"_a.noconvert().none(), "tiles"_a.noconvert(), "extent"_a.noconvert().none(),
        "mean_residual"_a.noconvert().none(), "pages"_a.noconvert().none(), "offset"_a, "scale"_a, "weight_bound"_a,
        "near"_a, "through_pixel"_a, "transmittance_min"_a, "viewmats"_a.noconvert(), "Ks"_a.noconvert(), "width"_a,
        "height"_a, "background"_a.noconvert().none(), "rgb"_a.noconvert().none(), "alpha"_a.noconvert().none(),
        "packed"_a.noconvert().none(), "beta"_a.noconvert().none(), "depth"_a.noconvert().none(),
        "normal"_a.noconvert().none(), "overdraw"_a.noconvert().none(), "stages"_a, "memory"_a.noconvert(),
        "capacity"_a, "stream"_a = 0);
}

}  // namespace bt::cuda
