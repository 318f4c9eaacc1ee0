// The residual field at points, and the colours of fragments.
#include "cpu/field.h"

#include "core/shading.h"

namespace bt {

namespace {
constexpr int64_t kChunk = 1 << 15;  // points whose table gradients are collected before they are added
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

template <class S> void shade_forward(const ShadeForward<S>& a) {
  const FragmentArrays<S>& f = a.f;
  const FieldArrays<S>* field = a.field;
  const S *base = a.base, *frames = a.frames, bound = a.bound;
  const int64_t fragments = f.total;
  S* colors = a.colors;
  Mlp<S, Lanes<S>> m;
  if (field) m = load_mlp(*field);
  parallel_parts(fragments, 1024, [&](int, int64_t begin, int64_t end) {
    Encoder<S> enc;
    MlpState<S, Lanes<S>> state;
    int64_t who[kBatch];
    int count = 0;
    for (int64_t i = begin; i < end; ++i) {
      store3(colors + 3 * i, view_base(load3(base + 3 * int64_t(f.surfel[i]))));
      if (field && f.weight[i] >= bound) {
        enc.set(count, world_point(frames + int64_t(f.surfel[i]) * kFrame, f.uv[i], f.uv[fragments + i]));
        who[count++] = i;
      }
      if (count == kBatch || (count && i + 1 == end)) {
        enc.encode(*field, count);
        for (int p = 0; p < count; ++p) {
          S* to = colors + 3 * who[p];
          store3(to, shaded(load3(to), mlp(m, enc.features[p], state)));
        }
        count = 0;
      }
    }
  });
}

template <class S> void shade_backward(const ShadeBackward<S>& a) {
  const FragmentArrays<S>& f = a.f;
  const FieldArrays<S>* field = a.field;
  const FieldGradients<S>* dfield = &a.dfield;
  const S *base = a.base, *frames = a.frames, *colors = a.colors, *dcolors = a.dcolors, bound = a.bound;
  S *dbase = a.dbase, *duv = a.duv, *dframes = a.dframes;
  const int64_t n = a.n, fragments = f.total;
  const bool geometry = duv != nullptr;
  const int threads = std::max(1, std::min(num_threads(), 64));
  const int columns = geometry ? 3 + kFrame : 3;
  std::vector<std::vector<S>> partial(threads);
  for (auto& p : partial) p.assign(n * columns, S(0));
  Mlp<S, Lanes<S>> m;
  std::vector<Mlp<S, Lanes<S>>> sums;
  TableScatter<S> scatter;
  const bool trains_field = a.trains_field();
  if (trains_field) {
    m = load_mlp(*field);
    sums.resize(threads);
    for (auto& g : sums) clear(g);
    clear_gradients(*field, *dfield);
  }
  if (geometry) std::fill(duv, duv + 2 * fragments, S(0));
  for (int64_t chunk = 0; chunk < fragments; chunk += trains_field ? kChunk : fragments) {
    const int64_t size = trains_field ? std::min(kChunk, fragments - chunk) : fragments;
    if (trains_field) scatter.resize(size, threads);
    parallel_parts(size, 256, [&](int part, int64_t begin, int64_t end) {
      std::vector<S>& own = partial[part];
      Encoder<S> enc;
      MlpState<S, Lanes<S>> state;
      MlpGradient<Lanes<S>> gradient;
      Vec3<S> drho[kBatch];
      int64_t who[kBatch];
      int count = 0;
      int64_t slot = scatter.slot(part, begin);
      S lanes[kWidth];
      for (int64_t k = begin; k < end; ++k) {
        const int64_t i = chunk + k, id = f.surfel[i];
        const Vec3<S> g = residual_gradient(load3(colors + 3 * i), load3(dcolors + 3 * i));
        S* sum = own.data() + id * columns;
        store3(sum, load3(sum) + base_gradient(load3(base + 3 * id), g));
        if (trains_field && f.weight[i] >= bound) {
          enc.set(count, world_point(frames + id * kFrame, f.uv[i], f.uv[fragments + i]));
          drho[count] = g;
          who[count++] = i;
        }
        if (count == kBatch || (count && k + 1 == end)) {
          enc.encode(*field, count);
          auto& batch = scatter.open(slot++, enc, field->levels, count);
          for (int p = 0; p < count; ++p) {
            mlp(m, enc.features[p], state);
            batch.dfeatures[p] = mlp_vjp(m, state, drho[p], gradient);
            add_weight_gradient(enc.features[p], state, gradient, drho[p], sums[part]);
            if (!geometry) continue;
            store(lanes, batch.dfeatures[p]);
            const Vec3<S> dx = enc.position_gradient(*field, p, lanes);
            const int64_t j = who[p], s = f.surfel[j];
            const S u = f.uv[j], v = f.uv[fragments + j];
            world_point_vjp(frames + s * kFrame, u, v, dx, duv[j], duv[fragments + j], own.data() + s * columns + 3);
          }
          count = 0;
        }
      }
    });
    if (trains_field) scatter.add(*field, dfield->table);
  }
  if (trains_field) add_mlp_gradient(sums, threads, field->levels * kFeatures, *dfield);
  parallel_parts(n, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      S total[3 + kFrame] = {};
      for (const auto& p : partial)
        for (int c = 0; c < columns; ++c) total[c] += p[i * columns + c];
      std::copy_n(total, 3, dbase + 3 * i);
      if (geometry) std::copy_n(total + 3, kFrame, dframes + i * kFrame);
    }
  });
}

#define BT_INSTANTIATE(S)                                \
  template void field_forward(const FieldForward<S>&);   \
  template void field_backward(const FieldBackward<S>&); \
  template void shade_forward(const ShadeForward<S>&);   \
  template void shade_backward(const ShadeBackward<S>&);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt
