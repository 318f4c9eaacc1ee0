// Residual field at points.
#include "cpu/field.h"

namespace bt {

namespace {
constexpr int64_t kChunk = 1 << 15;  // points between additions of table gradients
}

template <class S> void field_forward(const FieldForward<S>& a) {
  const FieldArrays<S>& field = *a.field;
  const S* x = a.x;
  S* rho = a.rho;
  const auto m = load_mlp(field);
  parallel_parts(a.n, 256, [&](int, int64_t begin, int64_t end) {
    Encoder<S> enc;
    MlpState<S, Lanes<S>> state;
    for (int64_t i = begin; i < end; i += kBatch) {
      const int count = int(std::min<int64_t>(kBatch, end - i));
      for (int p = 0; p < count; ++p) enc.set(p, load3(x + 3 * (i + p)));
      enc.encode(field, count);
      for (int p = 0; p < count; ++p) store3(rho + 3 * (i + p), mlp(m, enc.features[p], state));
    }
  });
}

template <class S> void field_backward(const FieldBackward<S>& a) {
  const FieldArrays<S>& field = *a.field;
  const FieldGradients<S>& out = a.dfield;
  const S *x = a.x, *drho = a.drho;
  const int64_t n = a.n;
  S* dx = a.dx;
  const auto m = load_mlp(field);
  const int threads = std::max(num_threads(), 1);
  std::vector<Mlp<S, Lanes<S>>> sums(threads);
  for (auto& g : sums) clear(g);
  clear_gradients(field, out);
  TableScatter<S> scatter;
  for (int64_t chunk = 0; chunk < n; chunk += kChunk) {
    const int64_t size = std::min(kChunk, n - chunk);
    scatter.resize(size, threads);
    parallel_parts(size, 256, [&](int part, int64_t begin, int64_t end) {
      Encoder<S> enc;
      MlpState<S, Lanes<S>> state;
      MlpGradient<Lanes<S>> gradient;
      S lanes[kWidth];
      int64_t slot = scatter.slot(part, begin);
      for (int64_t i = begin; i < end; i += kBatch) {
        const int count = int(std::min<int64_t>(kBatch, end - i));
        for (int p = 0; p < count; ++p) enc.set(p, load3(x + 3 * (chunk + i + p)));
        enc.encode(field, count);
        auto& batch = scatter.open(slot++, enc, field.levels, count);
        for (int p = 0; p < count; ++p) {
          const Vec3<S> d = load3(drho + 3 * (chunk + i + p));
          mlp(m, enc.features[p], state);
          batch.dfeatures[p] = mlp_vjp(m, state, d, gradient);
          add_weight_gradient(enc.features[p], state, gradient, d, sums[part]);
          if (dx) {
            store(lanes, batch.dfeatures[p]);
            store3(dx + 3 * (chunk + i + p), enc.position_gradient(field, p, lanes));
          }
        }
      }
    });
    scatter.add(field, out.table);
  }
  add_mlp_gradient(sums, threads, field.levels * kFeatures, out);
}

#define BT_INSTANTIATE(S)                              \
  template void field_forward(const FieldForward<S>&); \
  template void field_backward(const FieldBackward<S>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
