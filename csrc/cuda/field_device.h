// The residual field on CUDA: at points, at the fragments of a view (shading), and at the texels of an atlas.
//
// Work of one look-up with L = 4 levels: 32 entries of 16 bytes gathered from the table (1 KB of 32-byte sectors at
// worst; the table of at most 8 MB stays in the L2), 1,500 operations, of which 1,120 belong to the MLP. An H200
// gathers some 5 TB/s from its L2 and does 60 Tflop/s: 5 look-ups a ns by memory and 40 by arithmetic. The gathers
// decide, and neighbouring fragments that share cells find them in the L1. So a thread does one look-up, with the
// weights in shared memory, read by all lanes at once, 4 multiply-adds a load; tensor cores would round to tf32 and
// gain nothing. The backward pass repeats the look-up, adds 32 times 16 bytes to the table's gradient (one vector
// reduction each, once per run of fragments in one cell where that halves them) and takes 2,240 more operations.
//
// Here stands its device code: core/field.h on rows of 16 registers.
#pragma once

#include "cuda/kernels.h"
#include "cuda/warp.h"

namespace bt::cuda {

// A row of the MLP: registers, or one line of shared memory that is read four numbers at a time.
template <class S>
struct alignas(16) Row {
  S v[kWidth];
  Row() = default;
  BT_HD explicit Row(S value) {
    BT_UNROLL
    for (int i = 0; i < kWidth; ++i) v[i] = value;
  }
};
template <class S>
struct RowMask {
  bool v[kWidth];
};
#define BT_ROW_OPERATOR(op)                                \
  template <class S>                                       \
  BT_HD Row<S> operator op(Row<S> a, const Row<S>& b) {    \
    BT_UNROLL                                              \
    for (int i = 0; i < kWidth; ++i) a.v[i] op## = b.v[i]; \
    return a;                                              \
  }
BT_ROW_OPERATOR(+)
BT_ROW_OPERATOR(*)
#undef BT_ROW_OPERATOR
template <class S>
BT_HD RowMask<S> operator>(const Row<S>& a, const Row<S>& b) {
  RowMask<S> m;
  BT_UNROLL
  for (int i = 0; i < kWidth; ++i) m.v[i] = a.v[i] > b.v[i];
  return m;
}
template <class S>
BT_HD Row<S> select(const RowMask<S>& m, const Row<S>& yes, const Row<S>& no) {
  Row<S> r;
  BT_UNROLL
  for (int i = 0; i < kWidth; ++i) r.v[i] = m.v[i] ? yes.v[i] : no.v[i];
  return r;
}
template <class S>
BT_HD Row<S> relu(Row<S> a) {
  BT_UNROLL
  for (int i = 0; i < kWidth; ++i) a.v[i] = bt::relu(a.v[i]);
  return a;
}
template <class S>
BT_HD void store(S* to, const Row<S>& a) {
  BT_UNROLL
  for (int i = 0; i < kWidth; ++i) to[i] = a.v[i];
}
template <class S>
BT_HD S sum(const Row<S>& a) {
  S r[4] = {a.v[0], a.v[1], a.v[2], a.v[3]};
  BT_UNROLL
  for (int i = 4; i < kWidth; ++i) r[i % 4] += a.v[i];
  return (r[0] + r[2]) + (r[1] + r[3]);
}
// The 16 sums are chains enough: one multiply-add each per input.
template <class S>
BT_HD Row<S> product(const Row<S>* w, const S* in) {
  Row<S> a(S(0));
  BT_UNROLL
  for (int i = 0; i < kWidth; ++i) {
    const Row<S> row = w[i];
    BT_UNROLL
    for (int o = 0; o < kWidth; ++o) a.v[o] += row.v[o] * in[i];
  }
  return a;
}

template <class S>
using DeviceMlp = Mlp<S, Row<S>>;

// All threads of the block copy the weights to shared memory; ends with a barrier.
template <class S>
__device__ void load_mlp(const FieldArrays<S>& f, int thread, int threads, DeviceMlp<S>& m) {
  const int inputs = f.levels * kFeatures;
  for (int k = thread; k < kWidth * kWidth; k += threads) {
    const int i = k / kWidth, o = k % kWidth;
    m.w1[i].v[o] = m.w1t[o].v[i] = i < inputs ? f.w1[k] : S(0);
    m.w2[i].v[o] = m.w2t[o].v[i] = f.w2[k];
    if (o < 3) m.w3[o].v[i] = f.w3[i * 3 + o];
  }
  __syncthreads();
}

template <class S>
struct alignas(16) Entry {
  S v[kFeatures];
};
template <class S>
__device__ Entry<S> entry(const FieldArrays<S>& f, int level, uint32_t index) {
  return reinterpret_cast<const Entry<S>*>(f.table)[f.first_entry(level) + index];
}
template <class S>
__device__ Vec3<S> grid_position(const FieldArrays<S>& f, Vec3<S> x) {
  return grid_coordinate(x, load3(f.mid), f.half, f.contract);
}

// Interpolated features at a grid position; those of missing levels are 0.
template <class S>
__device__ void encode(const FieldArrays<S>& f, Vec3<S> c, S (&features)[kInputs]) {
  const uint32_t mask = f.hash_mask();
  BT_UNROLL
  for (int l = 0; l < kMaxLevels; ++l) {
    BT_UNROLL
    for (int j = 0; j < kFeatures; ++j) features[l * kFeatures + j] = S(0);
    if (l >= f.levels) continue;
    Corners<S> at;
    corners(c, f.resolution(l), mask, at);
    BT_UNROLL
    for (int k = 0; k < 8; ++k) {
      const Entry<S> e = entry(f, l, at.index[k]);
      BT_UNROLL
      for (int j = 0; j < kFeatures; ++j) features[l * kFeatures + j] += at.weight[k] * e.v[j];
    }
  }
}

template <class S>
__device__ Vec3<S> evaluate(const FieldArrays<S>& f, const DeviceMlp<S>& m, Vec3<S> x) {
  S features[kInputs];
  MlpState<S, Row<S>> state;
  encode(f, grid_position(f, x), features);
  return mlp(m, features, state);
}

// ---- backward, by warps

// What 32 look-ups put side by side for the weights' gradients. Rows are 84 numbers apart: eight lanes that write four
// numbers each touch all 32 banks.
template <class S>
struct Stage {
  enum { kX = 0, kH1 = 16, kG1 = 32, kG2 = 48, kH2 = 64, kD = 80, kColumns = 84 };
  alignas(16) S row[kWarp][kColumns];
};

// A lane's share of the weights' gradients: a 4 x 4 patch of w1 (lanes 0 to 15) or of w2, and three numbers of w3. The
// outer products of 32 look-ups are 560 multiply-adds per lane, two loads of four numbers for sixteen of them.
template <class S>
struct WeightSums {
  S patch[16], last[3];
  __device__ WeightSums() {
    BT_UNROLL
    for (S& p : patch) p = S(0);
    last[0] = last[1] = last[2] = S(0);
  }
  __device__ static int row(int lane) { return lane % 16 / 4 * 4; }
  __device__ static int column(int lane) { return lane % 4 * 4; }

  __device__ void add(const Stage<S>& stage, int lane) {
    const int in = (lane < 16 ? Stage<S>::kX : Stage<S>::kH1) + row(lane);
    const int out = (lane < 16 ? Stage<S>::kG1 : Stage<S>::kG2) + column(lane);
    for (int p = 0; p < kWarp; ++p) {
      const Entry<S> a = *reinterpret_cast<const Entry<S>*>(stage.row[p] + in);
      const Entry<S> b = *reinterpret_cast<const Entry<S>*>(stage.row[p] + out);
      BT_UNROLL
      for (int k = 0; k < 16; ++k) patch[k] += a.v[k / 4] * b.v[k % 4];
    }
    for (int p = lane / 16; p < kWarp; p += 2) {
      const S h = stage.row[p][Stage<S>::kH2 + lane % 16];
      const Entry<S> d = *reinterpret_cast<const Entry<S>*>(stage.row[p] + Stage<S>::kD);
      for (int c = 0; c < 3; ++c) last[c] += h * d.v[c];
    }
  }
  // Adds to a block's sums [kMlpWeights] in shared memory; the two lanes that share a number of w3 come one after the
  // other.
  __device__ void give(S* to, int lane) const {
    S* matrix = to + (lane < 16 ? 0 : kInputs * kWidth);
    for (int k = 0; k < 16; ++k) matrix[(row(lane) + k / 4) * kWidth + column(lane) + k % 4] += patch[k];
    S* w3 = to + 2 * kWidth * kWidth + lane % 16 * 3;
    for (int half = 0; half < 2; ++half) {
      if (lane / 16 == half)
        for (int c = 0; c < 3; ++c) w3[c] += last[c];
      __syncwarp();
    }
  }
};

// The cell of a grid position, as a number; up to a resolution of 2^21 every cell has its own.
template <class S>
__device__ uint64_t cell_of(Vec3<S> c, S resolution) {
  const uint64_t x = to_index(floor_(c.x * resolution)), y = to_index(floor_(c.y * resolution));
  const uint64_t z = to_index(floor_(c.z * resolution));
  return x | y << 21 | z << 42;
}

// Adds the table's gradient of 32 look-ups. Where that at least halves the additions, lanes with neighbours in the same
// cell add up first.
template <class S, bool kExact>
__device__ void scatter(const FieldArrays<S>& f, Vec3<S> c, const S (&dfeatures)[kInputs], bool active, int lane,
                        const Adder<S, kExact>& table) {
  const uint32_t mask = f.hash_mask();
  BT_UNROLL
  for (int l = 0; l < kMaxLevels; ++l) {
    if (l >= f.levels) continue;
    Corners<S> at;
    corners(c, f.resolution(l), mask, at);
    const S resolution = f.resolution(l);
    const unsigned run = run_of(active ? cell_of(c, resolution) : ~uint64_t(0), lane);
    const bool first = active && count_below(run, lane) == 0;
    const unsigned firsts = __ballot_sync(kFullMask, first), all = __ballot_sync(kFullMask, active);
    const bool together = 2 * __popc(firsts) <= __popc(all) && resolution <= S(1 << 21);
    const int64_t level = f.first_entry(l);
    BT_UNROLL
    for (int half = 0; half < 8; half += 4) {  // 16 numbers at a time: 32 would not fit in registers
      S value[4 * kFeatures];
      BT_UNROLL
      for (int k = 0; k < 4 * kFeatures; ++k)
        value[k] = active ? at.weight[half + k / kFeatures] * dfeatures[l * kFeatures + k % kFeatures] : S(0);
      if (together) sum_over_run(run, lane, value);
      if (!(together ? first : active)) continue;
      BT_UNROLL
      for (int k = 0; k < 4; ++k) table.add4((level + at.index[half + k]) * kFeatures, value + k * kFeatures);
    }
  }
}

// d loss / d x from that of the features.
template <class S>
__device__ Vec3<S> position_gradient(const FieldArrays<S>& f, Vec3<S> x, Vec3<S> c, const S (&dfeatures)[kInputs]) {
  const uint32_t mask = f.hash_mask();
  Vec3<S> dc = {S(0), S(0), S(0)};
  BT_UNROLL
  for (int l = 0; l < kMaxLevels; ++l) {
    if (l >= f.levels) continue;
    Corners<S> at;
    corners(c, f.resolution(l), mask, at);
    S d[8];
    BT_UNROLL
    for (int k = 0; k < 8; ++k) {
      const Entry<S> e = entry(f, l, at.index[k]);
      d[k] = S(0);
      BT_UNROLL
      for (int j = 0; j < kFeatures; ++j) d[k] += dfeatures[l * kFeatures + j] * e.v[j];
    }
    dc = dc + cell_gradient(at.fx, at.fy, at.fz, f.resolution(l), d);
  }
  return grid_coordinate_vjp(x, load3(f.mid), f.half, f.contract, dc);
}

// One backward look-up per lane; all 32 lanes take part, those that are not active add nothing. Returns d loss / d x if
// asked for.
template <class S, bool kExact>
__device__ Vec3<S> learn(const FieldArrays<S>& f, const DeviceMlp<S>& m, Vec3<S> x, Vec3<S> drho, bool active, int lane,
                         Stage<S>& stage, WeightSums<S>& weights, const Adder<S, kExact>& table, bool positions) {
  S dfeatures[kInputs];
  S* row = stage.row[lane];
  const Vec3<S> c = grid_position(f, x);
  if (active) {
    S features[kInputs];
    MlpState<S, Row<S>> state;
    MlpGradient<Row<S>> g;
    encode(f, c, features);
    mlp(m, features, state);
    const Row<S> d = mlp_vjp(m, state, drho, g);
    store(dfeatures, d);
    BT_UNROLL
    for (int i = 0; i < kInputs; ++i) row[Stage<S>::kX + i] = features[i];
    store(row + Stage<S>::kH1, state.h1);
    store(row + Stage<S>::kG1, g.g1);
    store(row + Stage<S>::kG2, g.g2);
    store(row + Stage<S>::kH2, state.h2);
    row[Stage<S>::kD] = drho.x, row[Stage<S>::kD + 1] = drho.y, row[Stage<S>::kD + 2] = drho.z;
    row[Stage<S>::kD + 3] = S(0);
  } else {
    BT_UNROLL
    for (int i = 0; i < Stage<S>::kColumns; ++i) row[i] = S(0);
    BT_UNROLL
    for (int i = 0; i < kInputs; ++i) dfeatures[i] = S(0);
  }
  __syncwarp();
  weights.add(stage, lane);
  __syncwarp();
  scatter(f, c, dfeatures, active, lane, table);
  if (!positions || !active) return {S(0), S(0), S(0)};
  return position_gradient(f, x, c, dfeatures);
}

// ---- blocks of a backward pass

template <class S>
constexpr int kBackwardWarps = sizeof(S) == 4 ? 4 : 2;  // a warp's stage is 10.5 KB, or 21 KB in double

template <class S>
struct BackwardShared {
  DeviceMlp<S> mlp;
  Stage<S> stage[kBackwardWarps<S>];
  int64_t queue[kBackwardWarps<S>][2 * kWarp];
};

// Sums of the block's warps, in their order, to the block's row of `out`.
template <class S>
__device__ void give_weights(BackwardShared<S>& shared, const WeightSums<S>& weights, int warp, int lane, S* out) {
  constexpr int kThreads = kBackwardWarps<S> * kWarp;
  static_assert(kMlpWeights <= kWarp * Stage<S>::kColumns, "the sums take the place of the first warp's stage");
  S* sums = &shared.stage[0].row[0][0];
  __syncthreads();
  for (int k = threadIdx.x; k < kMlpWeights; k += kThreads) sums[k] = S(0);
  __syncthreads();
  for (int w = 0; w < kBackwardWarps<S>; ++w) {
    if (w == warp) weights.give(sums, lane);
    __syncthreads();
  }
  for (int k = threadIdx.x; k < kMlpWeights; k += kThreads) out[int64_t(blockIdx.x) * kMlpWeights + k] = sums[k];
}

constexpr int kChunk = 8 * kWarp;  // consecutive items that a warp takes at a time

// Blocks of a backward pass over n items. A function of n alone: with it the order of all sums is fixed.
template <class S>
int backward_blocks(int64_t n) {
  const int64_t blocks = ceil_div(n, int64_t(kChunk) * kBackwardWarps<S>);
  return int(blocks < 1 ? 1 : blocks > kMostBlocks ? kMostBlocks : blocks);
}

// ---- steps around the backward kernels (field_sums.cu)

// In FieldWork::exact after the table: bits of the largest |gradient| and |entry| as doubles, and from them the units
// of the exact sums, as 1 / unit.
struct ExactRange {
  unsigned long long gradient, entry;
  double table, base, frames;
};
static_assert(sizeof(ExactRange) == kExactRange * sizeof(int64_t));
// Pointers into FieldWork::exact, all null when sums need not be exact.
struct ExactSums {
  unsigned long long *table = nullptr, *base = nullptr, *frames = nullptr;
  ExactRange* range = nullptr;
};
// Clears the exact sums and finds their units, such that no sum of `count` gradients [count, 3] can overflow. field may
// be null; frames tells whether those are summed.
template <class S>
ExactSums begin_exact(const FieldWork<S>& work, const FieldArrays<S>* field, int64_t surfels, bool frames,
                      int64_t count, const S* gradients, Stream stream);
// Writes the exact sums as numbers: where not null, dtable (of a given field), dbase and dframes.
template <class S>
void end_exact(const ExactSums& exact, const FieldArrays<S>* field, int64_t surfels, S* dtable, S* dbase, S* dframes,
               Stream stream);
// Adds up the blocks' sums of the weights' gradients.
template <class S>
void sum_weights(const S* partial, int blocks, int levels, const FieldGradients<S>& out, Stream stream);

}  // namespace bt::cuda
