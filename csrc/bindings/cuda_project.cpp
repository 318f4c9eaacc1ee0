#include "bindings/cuda.h"

namespace bt::cuda {
namespace {

template <class S>
void bind(nb::module_& m, const char* forward, const char* backward) {
  using In = Array<const S>;
  using Out = Array<S>;
  m.def(
      forward,
      [](In means, In quats, In log_scales, In opacity_logits, In beta_raw, In viewmat, In K, int width, int height,
         double near, bool through_pixel, Out geom, Out frames, Out radii, Array<int32_t> broken, uintptr_t stream) {
        const Surfels<S> in = surfels(means, quats, log_scales, opacity_logits, beta_raw);
        const int64_t n = in.n;
        project_forward(through_pixel, data(viewmat, 16, "viewmat"), data(K, 9, "K"), width, height, S(near), in,
                        data(geom, n * kGeom, "geom"), data(frames, n * kFrame, "frames"), data(radii, 2 * n, "radii"),
                        data(broken, 1, "broken"), stream_of(stream));
      },
      "means"_a.noconvert(), "quats"_a.noconvert(), "log_scales"_a.noconvert(), "opacity_logits"_a.noconvert(),
      "beta_raw"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a, "height"_a, "near"_a,
      "through_pixel"_a, "geom"_a.noconvert(), "frames"_a.noconvert(), "radii"_a.noconvert(), "broken"_a.noconvert(),
      "stream"_a = 0);
  m.def(
      backward,
      [](In means, In quats, In log_scales, In opacity_logits, In beta_raw, In viewmat, In K, In geom, In dgeom,
         Maybe<const S> dframes, Out dmeans, Out dquats, Out dlog_scales, Out dopacity_logits, Out dbeta_raw,
         uintptr_t stream) {
        const Surfels<S> in = surfels(means, quats, log_scales, opacity_logits, beta_raw);
        const int64_t n = in.n;
        const SurfelGradients<S> out = surfel_gradients(n, dmeans, dquats, dlog_scales, dopacity_logits, dbeta_raw);
        project_backward(data(viewmat, 16, "viewmat"), data(K, 9, "K"), in, data(geom, n * kGeom, "geom"),
                         data(dgeom, n * kGeom, "dgeom"), data_or_null(dframes, n * kFrame, "dframes"), out,
                         stream_of(stream));
      },
      "means"_a.noconvert(), "quats"_a.noconvert(), "log_scales"_a.noconvert(), "opacity_logits"_a.noconvert(),
      "beta_raw"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "geom"_a.noconvert(), "dgeom"_a.noconvert(),
      "dframes"_a.noconvert().none(), "dmeans"_a.noconvert(), "dquats"_a.noconvert(), "dlog_scales"_a.noconvert(),
      "dopacity_logits"_a.noconvert(), "dbeta_raw"_a.noconvert(), "stream"_a = 0);
}

}  // namespace

void bind_project(nb::module_& m) {
  bind<float>(m, "project_forward_f32", "project_backward_f32");
  bind<double>(m, "project_forward_f64", "project_backward_f64");
}

}  // namespace bt::cuda
