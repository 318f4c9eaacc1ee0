// The residual field on the CPU: batches of points, SIMD across the features and the hidden units.
#pragma once

#include "core/field.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace bt {

constexpr int kBatch = 16;  // points whose table entries are looked up together

// The weights as packs, with the transposes of the backward pass.
template <class S>
Mlp<S, Pack<S>> load_mlp(const FieldArrays<S>& field) {
  Mlp<S, Pack<S>> m;
  m.inputs = field.levels * kFeatures;
  for (int i = 0; i < kMaxLevels * kFeatures; ++i) m.w1[i] = i < m.inputs ? load(field.w1 + i * kWidth) : Pack<S>(S(0));
  for (int i = 0; i < kWidth; ++i) m.w2[i] = load(field.w2 + i * kWidth);
  for (int o = 0; o < kWidth; ++o)
    for (int i = 0; i < kWidth; ++i) {
      m.w1t[o].v[i] = i < m.inputs ? field.w1[i * kWidth + o] : S(0);
      m.w2t[o].v[i] = field.w2[i * kWidth + o];
    }
  for (int c = 0; c < 3; ++c)
    for (int i = 0; i < kWidth; ++i) m.w3[c].v[i] = field.w3[i * 3 + c];
  return m;
}
template <class S>
void clear(Mlp<S, Pack<S>>& m) {
  std::fill(std::begin(m.w1), std::end(m.w1), Pack<S>(S(0)));
  std::fill(std::begin(m.w2), std::end(m.w2), Pack<S>(S(0)));
  std::fill(std::begin(m.w3), std::end(m.w3), Pack<S>(S(0)));
}

// Encodes a batch of up to kBatch points; the indices and weights stay for the backward pass.
template <class S>
struct Encoder {
  Corners<S> at[kBatch][kMaxLevels];
  alignas(64) S features[kBatch][kMaxLevels * kFeatures];

  void find(const FieldArrays<S>& f, int count, const Vec3<S>* x) {
    const Vec3<S> mid = load3(f.mid);
    const uint32_t mask = (1u << f.log2_size) - 1u;
    for (int p = 0; p < count; ++p) {
      const Vec3<S> c = grid_coordinate(x[p], mid, f.half, f.contract);
      for (int l = 0; l < f.levels; ++l) {
        at[p][l] = corners(c, S(f.min_resolution << l), mask);
        const S* table = f.table + (int64_t(l) << f.log2_size) * kFeatures;
        for (int k = 0; k < 8; ++k) __builtin_prefetch(table + int64_t(at[p][l].index[k]) * kFeatures);
      }
    }
  }
  void gather(const FieldArrays<S>& f, int count) {
    for (int p = 0; p < count; ++p)
      for (int l = 0; l < f.levels; ++l) {
        const S* table = f.table + (int64_t(l) << f.log2_size) * kFeatures;
        Quad<S> sum = {};
        for (int k = 0; k < 8; ++k) {
          Quad<S> entry;
          std::memcpy(&entry, table + int64_t(at[p][l].index[k]) * kFeatures, sizeof entry);
          sum += at[p][l].weight[k] * entry;
        }
        std::memcpy(features[p] + l * kFeatures, &sum, sizeof sum);
      }
  }
  // d loss / d x of point p from that of its features
  Vec3<S> position_gradient(const FieldArrays<S>& f, int p, Vec3<S> x, const S* dfeatures) const {
    Vec3<S> dc = {S(0), S(0), S(0)};
    for (int l = 0; l < f.levels; ++l) {
      const S* table = f.table + (int64_t(l) << f.log2_size) * kFeatures;
      const Corners<S>& c = at[p][l];
      S d[8];
      for (int k = 0; k < 8; ++k) {
        const S* entry = table + int64_t(c.index[k]) * kFeatures;
        d[k] = S(0);
        for (int j = 0; j < kFeatures; ++j) d[k] += dfeatures[l * kFeatures + j] * entry[j];
      }
      const S gx = S(1) - c.fx, gy = S(1) - c.fy, gz = S(1) - c.fz, r = S(f.min_resolution << l);
      dc.x += r * (gy * gz * (d[1] - d[0]) + c.fy * gz * (d[3] - d[2]) + gy * c.fz * (d[5] - d[4]) +
                   c.fy * c.fz * (d[7] - d[6]));
      dc.y += r * (gx * gz * (d[2] - d[0]) + c.fx * gz * (d[3] - d[1]) + gx * c.fz * (d[6] - d[4]) +
                   c.fx * c.fz * (d[7] - d[5]));
      dc.z += r * (gx * gy * (d[4] - d[0]) + c.fx * gy * (d[5] - d[1]) + gx * c.fy * (d[6] - d[2]) +
                   c.fx * c.fy * (d[7] - d[3]));
    }
    return grid_coordinate_vjp(x, load3(f.mid), f.half, f.contract, dc);
  }
};

// Collects what points give to the table and adds it, level by level: no two threads write one level, and every entry
// sums its points in their order.
template <class S>
struct TableScatter {
  int64_t count = 0;
  std::vector<uint32_t> index;  // [count, levels, 8]
  std::vector<S> weight;        // likewise
  std::vector<S> dfeatures;     // [count, 16]
  void resize(int64_t n, int levels) {
    count = n;
    index.resize(n * levels * 8), weight.resize(n * levels * 8), dfeatures.resize(n * kMaxLevels * kFeatures);
  }
  void put(int64_t i, int levels, const Corners<S>* at, Pack<S> d) {
    for (int l = 0; l < levels; ++l) {
      std::memcpy(&index[(i * levels + l) * 8], at[l].index, sizeof at[l].index);
      std::memcpy(&weight[(i * levels + l) * 8], at[l].weight, sizeof at[l].weight);
    }
    store(&dfeatures[i * kMaxLevels * kFeatures], d);
  }
  // Closes the gaps between the parts, part p having filled `filled[p]` slots from `from[p]` on.
  void compact(int parts, const int64_t* from, const int64_t* filled, int levels) {
    int64_t to = 0;
    for (int p = 0; p < parts; ++p) {
      if (to != from[p] && filled[p]) {
        std::memmove(&index[to * levels * 8], &index[from[p] * levels * 8], filled[p] * levels * 8 * 4);
        std::memmove(&weight[to * levels * 8], &weight[from[p] * levels * 8], filled[p] * levels * 8 * sizeof(S));
        std::memmove(&dfeatures[to * kMaxLevels * kFeatures], &dfeatures[from[p] * kMaxLevels * kFeatures],
                     filled[p] * kMaxLevels * kFeatures * sizeof(S));
      }
      to += filled[p];
    }
    count = to;
  }
  void add(const FieldArrays<S>& f, S* dtable) const {
    const int levels = f.levels;
#pragma omp parallel for num_threads(std::min(num_threads(), levels)) schedule(static, 1)
    for (int l = 0; l < levels; ++l) {
      S* table = dtable + (int64_t(l) << f.log2_size) * kFeatures;
      for (int64_t i = 0; i < count; ++i) {
        Quad<S> d;
        std::memcpy(&d, &dfeatures[(i * kMaxLevels + l) * kFeatures], sizeof d);
        const uint32_t* at = &index[(i * levels + l) * 8];
        const S* w = &weight[(i * levels + l) * 8];
        if (i + 4 < count)
          for (int k = 0; k < 8; ++k) __builtin_prefetch(table + int64_t(at[4 * levels * 8 + k]) * kFeatures, 1);
        for (int k = 0; k < 8; ++k) {
          S* entry = table + int64_t(at[k]) * kFeatures;
          Quad<S> e;
          std::memcpy(&e, entry, sizeof e);
          e += w[k] * d;
          std::memcpy(entry, &e, sizeof e);
        }
      }
    }
  }
};

template <class S>
void add_mlp_gradient(const std::vector<Mlp<S, Pack<S>>>& parts, int count, int inputs, const FieldGradients<S>& out) {
  for (int p = 0; p < count; ++p) {
    for (int i = 0; i < inputs; ++i)
      for (int o = 0; o < kWidth; ++o) out.w1[i * kWidth + o] += parts[p].w1[i].v[o];
    for (int i = 0; i < kWidth; ++i) {
      for (int o = 0; o < kWidth; ++o) out.w2[i * kWidth + o] += parts[p].w2[i].v[o];
      for (int c = 0; c < 3; ++c) out.w3[i * 3 + c] += parts[p].w3[c].v[i];
    }
  }
}
template <class S>
void clear_gradients(const FieldArrays<S>& f, const FieldGradients<S>& out) {
  const int64_t entries = (int64_t(f.levels) << f.log2_size) * kFeatures;
  parallel_parts(entries, 1 << 16, [&](int, int64_t b, int64_t e) { std::fill(out.table + b, out.table + e, S(0)); });
  std::fill(out.w1, out.w1 + f.levels * kFeatures * kWidth, S(0));
  std::fill(out.w2, out.w2 + kWidth * kWidth, S(0));
  std::fill(out.w3, out.w3 + kWidth * 3, S(0));
}

}  // namespace bt
