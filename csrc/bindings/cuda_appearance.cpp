// View colours and SSIM.
#include <nanobind/stl/string.h>

#include "bindings/cuda.h"
#include "cuda/appearance.h"

namespace bt::cuda {
namespace {

template <class S>
ViewColorArrays<S> view_color_arrays(int64_t n, const std::string& kind, int terms, const Array<S>& a,
                                     const Array<S>& b, const Maybe<S>& c) {
  const int number = kind_number(kind);
  if (terms < 1 || terms > kMaxTerms) throw std::invalid_argument("a view colour has 1 to 32 terms");
  const ViewColorWidths w = view_color_widths(number, terms);
  if (w.c && !c) throw std::invalid_argument("the view colour sv has three parameters");
  return {number, terms, data(a, w.a * n, "a"), data(b, w.b * n, "b"), data_or_null(c, w.c * n, "c")};
}

template <class S>
void bind(nb::module_& m, const char* suffix) {
  const auto name = [&](const char* base) { return std::string(base) + suffix; };
  using In = Array<const S>;
  using Out = Array<S>;

  m.def(
      name("view_color_forward").c_str(),
      [](const std::string& kind, int terms, In a, In b, Maybe<const S> c, In means, Array<const double> center,
         Array<const uint8_t> active, Out out, uintptr_t stream) {
        const int64_t n = int64_t(active.size());
        view_color_forward(n, view_color_arrays<const S>(n, kind, terms, a, b, c), data(means, 3 * n, "means"),
                           data(center, 3, "center"), active.data(), data(out, 3 * n, "out"), stream_of(stream));
      },
      "kind"_a, "terms"_a, "a"_a.noconvert(), "b"_a.noconvert(), "c"_a.noconvert().none(), "means"_a.noconvert(),
      "center"_a.noconvert(), "active"_a.noconvert(), "out"_a.noconvert(), "stream"_a = 0);
  m.def(
      name("lean_color").c_str(),
      [](const std::string& kind, In base, Array<const int32_t> span, In terms, In means, Array<const double> center,
         Array<const uint8_t> active, Out out, uintptr_t stream) {
        const int64_t n = int64_t(active.size());
        const int number = kind_number(kind);
        const LeanColors<S> p = {number, data(base, 3 * n, "base"), terms.data(), data(span, 2 * n, "span")};
        lean_color(n, p, data(means, 3 * n, "means"), data(center, 3, "center"), active.data(), data(out, 3 * n, "out"),
                   stream_of(stream));
      },
      "kind"_a, "base"_a.noconvert(), "span"_a.noconvert(), "terms"_a.noconvert(), "means"_a.noconvert(),
      "center"_a.noconvert(), "active"_a.noconvert(), "out"_a.noconvert(), "stream"_a = 0);
  m.def(
      name("view_color_backward").c_str(),
      [](const std::string& kind, int terms, In a, In b, Maybe<const S> c, In means, Array<const double> center,
         Array<const uint8_t> active, In dout, Out da, Out db, Maybe<S> dc, Out dmeans, uintptr_t stream) {
        const int64_t n = int64_t(active.size());
        view_color_backward(n, view_color_arrays<const S>(n, kind, terms, a, b, c), data(means, 3 * n, "means"),
                            data(center, 3, "center"), active.data(), data(dout, 3 * n, "dout"),
                            view_color_arrays<S>(n, kind, terms, da, db, dc), data(dmeans, 3 * n, "dmeans"),
                            stream_of(stream));
      },
      "kind"_a, "terms"_a, "a"_a.noconvert(), "b"_a.noconvert(), "c"_a.noconvert().none(), "means"_a.noconvert(),
      "center"_a.noconvert(), "active"_a.noconvert(), "dout"_a.noconvert(), "da"_a.noconvert(), "db"_a.noconvert(),
      "dc"_a.noconvert().none(), "dmeans"_a.noconvert(), "stream"_a = 0);

  m.def(
      name("ssim_workspace").c_str(),
      [](int height, int width, int channels, bool gradient) {
        return ssim_workspace<S>(height, width, channels, gradient);
      },
      "height"_a, "width"_a, "channels"_a, "gradient"_a);
  m.def(
      name("ssim").c_str(),
      [](In a, In b, int height, int width, int channels, Maybe<S> da, Out value, Array<uint8_t> workspace,
         uintptr_t stream) {
        const int64_t size = int64_t(height) * width * channels;
        S* gradient = data_or_null(da, size, "da");
        if (int64_t(workspace.size()) < ssim_workspace<S>(height, width, channels, gradient))
          throw std::invalid_argument("the workspace is too small");
        ssim(height, width, channels, data(a, size, "a"), data(b, size, "b"), data(value, 1, "value"), gradient,
             workspace.data(), stream_of(stream));
      },
      "a"_a.noconvert(), "b"_a.noconvert(), "height"_a, "width"_a, "channels"_a, "da"_a.noconvert().none(),
      "value"_a.noconvert(), "workspace"_a.noconvert(), "stream"_a = 0);
}

}  // namespace

void bind_appearance(nb::module_& m) {
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
}

}  // namespace bt::cuda
