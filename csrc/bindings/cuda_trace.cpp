#include "bindings/cuda.h"

namespace bt::cuda {
namespace {

int64_t tiles_of(int width, int height) { return int64_t(tiles_across(width)) * tiles_across(height); }
// Pairs are counted in 32 bits.
int64_t checked_pairs(int64_t pairs) {
  if (pairs > INT32_MAX) throw std::invalid_argument("more than 2^31 pairs of surfel and tile");
  return pairs;
}
template <class T>
void* memory(const Array<T>& workspace, int64_t size) {
  if (int64_t(workspace.size()) < size) throw std::invalid_argument("the workspace is too small");
  return workspace.data();
}

template <class S>
void bind(nb::module_& m, const char* suffix) {
  const auto name = [&](const char* base) { return std::string(base) + suffix; };
  using In = Array<const S>;
  using Out = Array<S>;
  using Ints = Array<int32_t>;
  using Longs = Array<int64_t>;
  using Bytes = Array<uint8_t>;

  m.def(name("bin_count_workspace").c_str(), &bin_count_workspace<S>, "n"_a);
  m.def(
      name("bin_count").c_str(),
      [](In geom, In radii, int width, int height, bool through_pixel, Ints order, Longs slot_start, Bytes workspace,
         uintptr_t stream) {
        const int64_t n = int64_t(order.size());
        bin_count(through_pixel, n, rows(geom, n * kGeom, "geom"), data(radii, 2 * n, "radii"), width, height,
                  order.data(), data(slot_start, n + 1, "slot_start"), memory(workspace, bin_count_workspace<S>(n)),
                  stream_of(stream));
      },
      "geom"_a.noconvert(), "radii"_a.noconvert(), "width"_a, "height"_a, "through_pixel"_a, "order"_a.noconvert(),
      "slot_start"_a.noconvert(), "workspace"_a.noconvert(), "stream"_a = 0);

  m.def(
      name("bin_fill_workspace").c_str(),
      [](int64_t pairs, int width, int height) {
        return bin_fill_workspace(checked_pairs(pairs), tiles_of(width, height));
      },
      "pairs"_a, "width"_a, "height"_a);
  m.def(
      name("bin_fill").c_str(),
      [](In geom, int width, int height, bool through_pixel, Array<const int32_t> order,
         Array<const int64_t> slot_start, Ints slot, Ints surfel, Longs tile_pairs, Bytes workspace, uintptr_t stream) {
        const int64_t n = int64_t(order.size()), pairs = checked_pairs(int64_t(slot.size()));
        const int64_t tiles = tiles_of(width, height);
        bin_fill(through_pixel, n, rows(geom, n * kGeom, "geom"), width, height, order.data(),
                 data(slot_start, n + 1, "slot_start"), pairs, slot.data(), data(surfel, pairs, "surfel"),
                 data(tile_pairs, tiles + 1, "tile_pairs"), memory(workspace, bin_fill_workspace(pairs, tiles)),
                 stream_of(stream));
      },
      "geom"_a.noconvert(), "width"_a, "height"_a, "through_pixel"_a, "order"_a.noconvert(), "slot_start"_a.noconvert(),
      "slot"_a.noconvert(), "surfel"_a.noconvert(), "tile_pairs"_a.noconvert(), "workspace"_a.noconvert(),
      "stream"_a = 0);

  m.def(
      name("trace_mark_workspace").c_str(), [](int64_t pairs) { return trace_mark_workspace(checked_pairs(pairs)); },
      "pairs"_a);
  m.def(
      name("trace_mark").c_str(),
      [](In geom, In radii, double near, bool through_pixel, int width, int height, Array<const int32_t> surfel,
         Array<const int64_t> tile_pairs, Ints masks, Longs offsets, Longs tile_start, Bytes workspace,
         uintptr_t stream) {
        const int64_t n = int64_t(radii.size()) / 2, pairs = checked_pairs(int64_t(surfel.size()));
        const int64_t tiles = tiles_of(width, height);
        trace_mark(through_pixel, rows(geom, n * kGeom, "geom"), radii.data(), S(near), width, height, pairs,
                   surfel.data(), data(tile_pairs, tiles + 1, "tile_pairs"),
                   reinterpret_cast<uint32_t*>(data(masks, kTileWarps * pairs, "masks")),
                   data(offsets, pairs + 1, "offsets"), data(tile_start, tiles + 1, "tile_start"),
                   memory(workspace, trace_mark_workspace(pairs)), stream_of(stream));
      },
      "geom"_a.noconvert(), "radii"_a.noconvert(), "near"_a, "through_pixel"_a, "width"_a, "height"_a,
      "surfel"_a.noconvert(), "tile_pairs"_a.noconvert(), "masks"_a.noconvert(), "offsets"_a.noconvert(),
      "tile_start"_a.noconvert(), "workspace"_a.noconvert(), "stream"_a = 0);
  m.def(
      name("trace_fill").c_str(),
      [](In geom, double near, bool through_pixel, const PairsHandle& pairs, Ints surfel, Ints pixel, Out weight,
         Out uv, Out depth, Out sigma, uintptr_t stream) {
        trace_fill(through_pixel, rows(geom, pairs.pairs.surfels * kGeom, "geom"), S(near), pairs.pairs,
                   fragments<S>(pairs.fragments, surfel, pixel, weight, uv, depth, sigma), stream_of(stream));
      },
      "geom"_a.noconvert(), "near"_a, "through_pixel"_a, "pairs"_a, "surfel"_a.noconvert(), "pixel"_a.noconvert(),
      "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "stream"_a = 0);

  m.def(
      name("trace_backward").c_str(),
      [](In geom, double near, bool through_pixel, double rim, const PairsHandle& pairs, Ints surfel, Ints pixel,
         Out weight, Out uv, Out depth, Out sigma, Maybe<const S> dweight, Maybe<const S> duv, Maybe<const S> ddepth,
         Out dsigma, Out partial, Out dgeom, Out absgrad, uintptr_t stream) {
        const Pairs& p = pairs.pairs;
        const int64_t f = pairs.fragments;
        trace_backward(through_pixel, rows(geom, p.surfels * kGeom, "geom"), S(near), S(rim), p,
                       fragments<S>(f, surfel, pixel, weight, uv, depth, sigma), data_or_null(dweight, f, "dweight"),
                       data_or_null(duv, 2 * f, "duv"), data_or_null(ddepth, f, "ddepth"), data(dsigma, f, "dsigma"),
                       data(partial, kTraceSums * p.pairs, "partial"), data(dgeom, p.surfels * kGeom, "dgeom"),
                       data(absgrad, 2 * p.surfels, "absgrad"), stream_of(stream));
      },
      "geom"_a.noconvert(), "near"_a, "through_pixel"_a, "rim"_a, "pairs"_a, "surfel"_a.noconvert(),
      "pixel"_a.noconvert(), "weight"_a.noconvert(), "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(),
      "dweight"_a.noconvert().none(), "duv"_a.noconvert().none(), "ddepth"_a.noconvert().none(), "dsigma"_a.noconvert(),
      "partial"_a.noconvert(), "dgeom"_a.noconvert(), "absgrad"_a.noconvert(), "stream"_a = 0);

  m.def(
      name("composite_forward").c_str(),
      [](bool maps, In geom, const PairsHandle& pairs, Ints surfel, Ints pixel, Out weight, Out uv, Out depth,
         Out sigma, In colors, Out image, uintptr_t stream) {
        const Pairs& p = pairs.pairs;
        const int64_t f = pairs.fragments, channels = maps ? kMapChannels : kImageChannels;
        composite_forward(maps, data(geom, p.surfels * kGeom, "geom"), p,
                          fragments<S>(f, surfel, pixel, weight, uv, depth, sigma), data(colors, 3 * f, "colors"),
                          data(image, int64_t(p.width) * p.height * channels, "image"), stream_of(stream));
      },
      "maps"_a, "geom"_a.noconvert(), "pairs"_a, "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(),
      "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "colors"_a.noconvert(), "image"_a.noconvert(),
      "stream"_a = 0);
  m.def(
      name("composite_backward").c_str(),
      [](bool maps, In geom, const PairsHandle& pairs, Ints surfel, Ints pixel, Out weight, Out uv, Out depth,
         Out sigma, In colors, In dimage, Out partial, Out dweight, Out dcolors, Maybe<S> ddepth, Out dgeom,
         uintptr_t stream) {
        const Pairs& p = pairs.pairs;
        const int64_t f = pairs.fragments, channels = maps ? kMapChannels : kImageChannels;
        S* dz = data_or_null(ddepth, f, "ddepth");
        if (maps && !dz) throw std::invalid_argument("maps need ddepth");
        composite_backward(
            maps, data(geom, p.surfels * kGeom, "geom"), p, fragments<S>(f, surfel, pixel, weight, uv, depth, sigma),
            data(colors, 3 * f, "colors"), data(dimage, int64_t(p.width) * p.height * channels, "dimage"),
            data(partial, p.pairs * (maps ? 4 : 1), "partial"), data(dweight, f, "dweight"),
            data(dcolors, 3 * f, "dcolors"), dz, data(dgeom, p.surfels * kGeom, "dgeom"), stream_of(stream));
      },
      "maps"_a, "geom"_a.noconvert(), "pairs"_a, "surfel"_a.noconvert(), "pixel"_a.noconvert(), "weight"_a.noconvert(),
      "uv"_a.noconvert(), "depth"_a.noconvert(), "sigma"_a.noconvert(), "colors"_a.noconvert(), "dimage"_a.noconvert(),
      "partial"_a.noconvert(), "dweight"_a.noconvert(), "dcolors"_a.noconvert(), "ddepth"_a.noconvert().none(),
      "dgeom"_a.noconvert(), "stream"_a = 0);
}

}  // namespace

void bind_trace(nb::module_& m) {
  using Ints = Array<const int32_t>;
  using Longs = Array<const int64_t>;
  nb::class_<PairsHandle>(m, "Pairs", "How kernels find their way in a fragment list (csrc/cuda/pairs.h).")
      .def(
          "__init__",
          [](PairsHandle* self, int width, int height, int64_t fragments, Ints surfel, Ints slot, Ints masks,
             Longs offsets, Longs tile_pairs, Ints order, Longs slot_start) {
            const int64_t n = int64_t(order.size()), pairs = checked_pairs(int64_t(surfel.size()));
            const Pairs p = {width,
                             height,
                             n,
                             pairs,
                             surfel.data(),
                             data(slot, pairs, "slot"),
                             reinterpret_cast<const uint32_t*>(data(masks, kTileWarps * pairs, "masks")),
                             data(offsets, pairs + 1, "offsets"),
                             data(tile_pairs, tiles_of(width, height) + 1, "tile_pairs"),
                             order.data(),
                             data(slot_start, n + 1, "slot_start")};
            new (self) PairsHandle{surfel, slot, masks, offsets, tile_pairs, order, slot_start, p, fragments};
          },
          "width"_a, "height"_a, "fragments"_a, "surfel"_a.noconvert(), "slot"_a.noconvert(), "masks"_a.noconvert(),
          "offsets"_a.noconvert(), "tile_pairs"_a.noconvert(), "order"_a.noconvert(), "slot_start"_a.noconvert())
      .def_prop_ro("pairs", [](const PairsHandle& p) { return p.pairs.pairs; })
      .def_prop_ro("fragments", [](const PairsHandle& p) { return p.fragments; });
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
  m.attr("TILE_WARPS") = kTileWarps;
  m.attr("TRACE_SUMS") = kTraceSums;
  m.def(
      "masked_counts",
      [](const PairsHandle& pairs, Array<const uint8_t> mask, Array<int32_t> counts, uintptr_t stream) {
        const Pairs& p = pairs.pairs;
        masked_counts(p, data(mask, int64_t(p.width) * p.height, "mask"), data(counts, p.surfels, "counts"),
                      stream_of(stream));
      },
      "pairs"_a, "mask"_a.noconvert(), "counts"_a.noconvert(), "stream"_a = 0);
}

}  // namespace bt::cuda
