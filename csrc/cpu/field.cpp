// Residual field at points: batches of points, SIMD across features and hidden units.
#include "core/field.h"

#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace bt {

namespace {
constexpr int64_t kChunk = 1 << 15;  // points between additions of table gradients
constexpr int kBatch = 16;           // points per batch of table lookups

template <class S> Mlp<S, Lanes<S>> load_mlp(const FieldArrays<S>& field) {
  Mlp<S, Lanes<S>> m;
  const int inputs = field.levels * kFeatures;
  for (int i = 0; i < kInputs; ++i) m.w1[i] = i < inputs ? load(field.w1 + i * kWidth) : Lanes<S>(S(0));
  for (int i = 0; i < kWidth; ++i) m.w2[i] = load(field.w2 + i * kWidth);
  for (int o = 0; o < kWidth; ++o)
    for (int i = 0; i < kWidth; ++i) {
      m.w1t[o].set(i, i < inputs ? field.w1[i * kWidth + o] : S(0));
      m.w2t[o].set(i, field.w2[i * kWidth + o]);
    }
  for (int c = 0; c < 3; ++c)
    for (int i = 0; i < kWidth; ++i) m.w3[c].set(i, field.w3[i * 3 + c]);
  return m;
}
template <class S> void clear(Mlp<S, Lanes<S>>& m) {
  std::fill(std::begin(m.w1), std::end(m.w1), Lanes<S>(S(0)));
  std::fill(std::begin(m.w2), std::end(m.w2), Lanes<S>(S(0)));
  std::fill(std::begin(m.w3), std::end(m.w3), Lanes<S>(S(0)));
}

// Encodes a batch of kBatch points; indices and weights are kept for the backward pass.
template <class S> struct Encoder {
  using P = Lanes<S>;
  Corners<P> at[kMaxLevels];
  alignas(64) S features[kBatch][kInputs] = {};
  alignas(64) S x[3][kBatch] = {};

  void set(int p, Vec3<S> a) { x[0][p] = a.x, x[1][p] = a.y, x[2][p] = a.z; }
  Vec3<S> point(int p) const { return {x[0][p], x[1][p], x[2][p]}; }
  static const S* level(const FieldArrays<S>& f, int l) { return f.table + f.first_entry(l) * kFeatures; }

  void encode(const FieldArrays<S>& f, int count) {
    const uint32_t mask = f.hash_mask();
    const Vec3<P> c = grid_coordinate(Vec3<P>{load(x[0]), load(x[1]), load(x[2])}, load3(f.mid), f.half, f.contract);
    for (int l = 0; l < f.levels; ++l) corners(c, P(f.resolution(l)), mask, at[l]);
    // prefetch all lines before the first is needed
    for (int l = 0; l < f.levels; ++l)
      for (int k = 0; k < 8; ++k)
        for (int p = 0; p < count; ++p) __builtin_prefetch(level(f, l) + int64_t(at[l].index[k][p]) * kFeatures);
    for (int l = 0; l < f.levels; ++l) {
      const S* table = level(f, l);
      for (int p = 0; p < count; ++p) {
        Quad<S> sum = {};
        for (int k = 0; k < 8; ++k) {
          Quad<S> entry;
          std::memcpy(&entry, table + int64_t(at[l].index[k][p]) * kFeatures, sizeof entry);
          sum += at[l].weight[k][p] * entry;
        }
        std::memcpy(features[p] + l * kFeatures, &sum, sizeof sum);
      }
    }
  }
  // Computes d loss / d x of point p from that of its features.
  Vec3<S> position_gradient(const FieldArrays<S>& f, int p, const S* dfeatures) const {
    Vec3<S> dc = {S(0), S(0), S(0)};
    for (int l = 0; l < f.levels; ++l) {
      const Corners<P>& c = at[l];
      S d[8];
      for (int k = 0; k < 8; ++k) {
        const S* entry = level(f, l) + int64_t(c.index[k][p]) * kFeatures;
        d[k] = S(0);
        for (int j = 0; j < kFeatures; ++j) d[k] += dfeatures[l * kFeatures + j] * entry[j];
      }
      dc = dc + cell_gradient(c.fx[p], c.fy[p], c.fz[p], f.resolution(l), d);
    }
    return grid_coordinate_vjp(point(p), load3(f.mid), f.half, f.contract, dc);
  }
};

// Adds gradients of the table from batches of points level by level: no level is written by two threads, and every
// entry sums its points in order.
template <class S> struct TableScatter {
  struct Batch {
    int count = 0;
    typename IndexOf<Lanes<S>>::type index[kMaxLevels][8];
    Lanes<S> weight[kMaxLevels][8];
    Lanes<S> dfeatures[kBatch];
  };
  std::vector<Batch> batches;
  // Reserves n points in `parts` parts; part p, which begins at point b, uses batches from slot(p, b) on.
  void resize(int64_t n, int parts) {
    batches.resize(n / kBatch + 2 * parts + 1);
    for (Batch& b : batches) b.count = 0;
  }
  static int64_t slot(int part, int64_t begin) { return begin / kBatch + 2 * part; }
  Batch& open(int64_t at, const Encoder<S>& e, int levels, int count) {
    Batch& b = batches[at];
    b.count = count;
    for (int l = 0; l < levels; ++l)
      for (int k = 0; k < 8; ++k) b.index[l][k] = e.at[l].index[k], b.weight[l][k] = e.at[l].weight[k];
    return b;
  }
  void add(const FieldArrays<S>& f, S* dtable) const {
    parallel_parts(f.levels, 1, [&](int, int64_t from, int64_t to) {
      for (int l = int(from); l < to; ++l) add_level(l, dtable + f.first_entry(l) * kFeatures);
    });
  }

 private:
  void add_level(int l, S* table) const {
    for (const Batch& b : batches) {
      for (int k = 0; k < 8; ++k)
        for (int p = 0; p < b.count; ++p) __builtin_prefetch(table + int64_t(b.index[l][k][p]) * kFeatures, 1);
      for (int p = 0; p < b.count; ++p) {
        Quad<S> d;
        std::memcpy(&d, reinterpret_cast<const S*>(&b.dfeatures[p]) + l * kFeatures, sizeof d);
        for (int k = 0; k < 8; ++k) {
          S* entry = table + int64_t(b.index[l][k][p]) * kFeatures;
          Quad<S> e;
          std::memcpy(&e, entry, sizeof e);
          e += b.weight[l][k][p] * d;
          std::memcpy(entry, &e, sizeof e);
        }
      }
    }
  }
};

template <class S>
void add_mlp_gradient(const std::vector<Mlp<S, Lanes<S>>>& parts, int count, int inputs, const FieldGradients<S>& out) {
  for (int p = 0; p < count; ++p) {
    for (int i = 0; i < inputs; ++i)
      for (int o = 0; o < kWidth; ++o) out.w1[i * kWidth + o] += parts[p].w1[i][o];
    for (int i = 0; i < kWidth; ++i) {
      for (int o = 0; o < kWidth; ++o) out.w2[i * kWidth + o] += parts[p].w2[i][o];
      for (int c = 0; c < 3; ++c) out.w3[i * 3 + c] += parts[p].w3[c][i];
    }
  }
}
template <class S> void clear_gradients(const FieldArrays<S>& f, const FieldGradients<S>& out) {
  parallel_parts(f.table_size(), 1 << 16,
                 [&](int, int64_t b, int64_t e) { std::fill(out.table + b, out.table + e, S(0)); });
  std::fill(out.w1, out.w1 + f.levels * kFeatures * kWidth, S(0));
  std::fill(out.w2, out.w2 + kWidth * kWidth, S(0));
  std::fill(out.w3, out.w3 + kWidth * 3, S(0));
}
}  // namespace

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

BT_INSTANTIATE(field_forward, FieldForward)
BT_INSTANTIATE(field_backward, FieldBackward)

}  // namespace bt
