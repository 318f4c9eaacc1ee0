// Residual field at points.
//
// A look-up with L = 4 levels gathers 32 entries of 16 bytes (1 KB of 32-byte sectors at worst; the table of at most 8
// MB stays in L2, and neighbouring points share cells in L1) and runs an MLP of 560 multiply-adds, 1,680 with
// gradients. The kernels are bound by instruction issue and by warps available to hide latency. So a warp takes 32
// look-ups, gathers with a lane per look-up, passes the features through shared memory, and runs the MLP on tensor
// cores (warp_mlp.h): 24 steps instead of 256 multiply-adds and 64 loads per lane. The backward pass repeats the
// look-up and adds 32 times 16 bytes to the table's gradient, one vector reduction each, after summing over
// neighbouring points in a cell.
#include "cuda/kernels.h"
#include "cuda/warp.h"
#include "cuda/warp_mlp.h"

namespace bt::cuda {

namespace {
template <class S> struct alignas(16) Entry {
  S v[kFeatures];
};
template <class S> __device__ Entry<S> entry(const FieldArrays<S>& f, int level, uint32_t index) {
  return reinterpret_cast<const Entry<S>*>(f.table)[f.first_entry(level) + index];
}
template <class S> __device__ Vec3<S> grid_position(const FieldArrays<S>& f, Vec3<S> x) {
  return grid_coordinate(x, load3(f.mid), f.half, f.contract);
}

// Writes the interpolated features at a grid position; 0 for missing levels and inactive look-ups. All entries of a
// level are requested before the first is used, and its features are stored at once to free registers.
template <class S> __device__ void encode(const FieldArrays<S>& f, Vec3<S> c, bool active, S* to) {
  const uint32_t mask = f.hash_mask();
  BT_UNROLL
  for (int l = 0; l < kMaxLevels; ++l) {
    Entry<S> features = {};
    if (l < f.levels && active) {
      Corners<S> at;
      corners(c, f.resolution(l), mask, at);
      Entry<S> e[8];
      BT_UNROLL
      for (int k = 0; k < 8; ++k) e[k] = entry(f, l, at.index[k]);
      BT_UNROLL
      for (int k = 0; k < 8; ++k) {
        BT_UNROLL
        for (int j = 0; j < kFeatures; ++j) features.v[j] += at.weight[k] * e[k].v[j];
      }
    }
    *reinterpret_cast<Entry<S>*>(to + l * kFeatures) = features;
  }
}

// Memory of a warp for 32 values of the field. The row stride of 24 avoids bank conflicts between lanes that read pairs
// of a first factor.
template <class S> struct ForwardStage {
  enum { kX = 0, kOut = 16, kColumns = 24 };
  alignas(16) S number[kWarp * kColumns];
};
// Evaluates the residual at a point per lane. All 32 lanes take part; inactive ones get the value at features of 0.
template <class S>
__device__ Vec3<S> evaluate(const FieldArrays<S>& f, const ForwardMlp<S>& m, Vec3<S> x, bool active, int lane,
                            ForwardStage<S>& stage) {
  using Stage = ForwardStage<S>;
  S* mine = stage.number + lane * Stage::kColumns;
  encode(f, grid_position(f, x), active, mine + Stage::kX);
  __syncwarp();
  const auto row = [&](int p) { return stage.number + p * Stage::kColumns; };
  const Rows<S> h1 = rectified(layer(load_rows<S>(lane, row), m.w1, lane));
  const Rows<S> h2 = rectified(layer(h1, m.w2, lane));
  S rho[2][1][4];
  product(h2, m.w3, lane, rho);
  if (lane % 4 < 2) {  // other lanes hold columns 4 to 7
    BT_UNROLL
    for (int i = 0; i < 4; ++i)
      *reinterpret_cast<Pair<S>*>(row(8 * i + lane / 4) + Stage::kOut +
                                  lane % 4 * 2) = {{rho[i / 2][0][i % 2 * 2], rho[i / 2][0][i % 2 * 2 + 1]}};
  }
  __syncwarp();
  return load3(mine + Stage::kOut);
}

// ---- backward pass, by warps

// Memory of a warp for 32 look-ups. First the layers' inputs and gradients and the point, a row per look-up; the stride
// of 72 avoids bank conflicts along rows and columns. Later, in the same memory, the gradients of the features, and
// weights and entries of a level's corners (two levels alternate). Look-ups 0, 8, 16 and 24 are then read together, so
// each group of eight starts at another bank.
template <class S> struct Stage {
  enum { kX = 0, kH1 = 16, kG1 = 32, kG2 = 48, kD = 64, kPoint = 68, kColumns = 72 };
  enum { kFeatureRows = 648, kCornerRows = 280 };
  alignas(16) S number[kWarp * kColumns];
  static_assert(kFeatureRows + 4 * kCornerRows <= kWarp * kColumns, "the second use fits into the memory of the first");

  __device__ S* row(int p) { return number + p * kColumns; }
  __device__ S* feature_gradients(int p) { return number + p * 20 + p / 8 * 4; }
  __device__ S* corner_weights(int turn, int p) {
    return number + kFeatureRows + turn * kCornerRows + p * 8 + p / 8 * 8;
  }
  __device__ uint32_t* corner_indices(int turn, int p) {
    uint32_t* all = reinterpret_cast<uint32_t*>(number + kFeatureRows + 2 * kCornerRows);
    return all + turn * kCornerRows + p * 8 + p / 8 * 8;
  }
};

// Adds the table's gradient of 32 look-ups at a level: four groups of eight lanes, a lane per corner, go through eight
// look-ups each and sum those in one cell before writing. `ends`: look-ups whose successor is in another cell; none if
// all are in one.
template <class S, bool kExact>
__device__ void scatter(Stage<S>& stage, int turn, int level, int64_t first_entry, unsigned actives, unsigned ends,
                        int lane, const Adder<S, kExact>& table) {
  const int group = lane / 8 * 8, corner = lane % 8;
  Entry<S> sum = {};
  const auto take = [&](int p) {
    const S weight = stage.corner_weights(turn, p)[corner];
    const Entry<S> d = *reinterpret_cast<const Entry<S>*>(stage.feature_gradients(p) + level * kFeatures);
    BT_UNROLL
    for (int j = 0; j < kFeatures; ++j) sum.v[j] += weight * d.v[j];
  };
  const auto add = [&](int p) { table.add4((first_entry + stage.corner_indices(turn, p)[corner]) * kFeatures, sum.v); };
  if (!ends) {
    BT_UNROLL
    for (int i = 0; i < 8; ++i) take(group + i);
    for (int other = 8; other < kWarp; other *= 2) {
      BT_UNROLL
      for (int j = 0; j < kFeatures; ++j) sum.v[j] += __shfl_xor_sync(kFullMask, sum.v[j], other);
    }
    if (group == 0 && actives) add(0);
    return;
  }
  ends |= actives & (0x80808080u | ~(actives >> 1));  // and the last of each group, and of all
  BT_UNROLL
  for (int i = 0; i < 8; ++i) {
    take(group + i);
    if (!(ends >> (group + i) & 1u)) continue;
    add(group + i);
    sum = {};
  }
}

// Adds the table's gradient, and returns d loss / d grid position if requested, for 32 look-ups whose feature gradients
// are in the stage. Inactive lanes come last; their gradients are 0.
template <class S, bool kExact>
__device__ Vec3<S> encode_vjp(const FieldArrays<S>& f, Vec3<S> c, bool active, int lane, Stage<S>& stage,
                              const Adder<S, kExact>& table, bool positions) {
  const uint32_t mask = f.hash_mask();
  const unsigned actives = __ballot_sync(kFullMask, active);
  const bool followed = lane < kWarp - 1 && (actives >> (lane + 1) & 1u);
  Vec3<S> dc = {S(0), S(0), S(0)};
  BT_UNROLL_BY(1)
  for (int l = 0; l < f.levels; ++l) {
    Corners<S> at;
    const S resolution = f.resolution(l);
    const int turn = l % 2;
    corners(c, resolution, mask, at);
    S* weights = stage.corner_weights(turn, lane);
    uint32_t* indices = stage.corner_indices(turn, lane);
    BT_UNROLL
    for (int k = 0; k < 8; ++k) weights[k] = at.weight[k], indices[k] = at.index[k];
    const auto next_x = __shfl_sync(kFullMask, at.x, lane + 1), next_y = __shfl_sync(kFullMask, at.y, lane + 1),
               next_z = __shfl_sync(kFullMask, at.z, lane + 1);
    const bool same = next_x == at.x && next_y == at.y && next_z == at.z;
    const unsigned ends = __ballot_sync(kFullMask, active && followed && !same);
    __syncwarp();
    if (positions) {
      const Entry<S> df = *reinterpret_cast<const Entry<S>*>(stage.feature_gradients(lane) + l * kFeatures);
      S d[8];
      BT_UNROLL
      for (int k = 0; k < 8; ++k) {
        const Entry<S> e = entry(f, l, at.index[k]);
        d[k] = (df.v[0] * e.v[0] + df.v[1] * e.v[1]) + (df.v[2] * e.v[2] + df.v[3] * e.v[3]);
      }
      dc = dc + cell_gradient(at.fx, at.fy, at.fz, resolution, d);
    }
    scatter(stage, turn, l, f.first_entry(l), actives, ends, lane, table);
  }
  return dc;
}

// Runs one backward look-up per lane; all 32 lanes take part. Inactive lanes come last and add nothing. Returns d loss
// / d x if requested.
template <class S, bool kExact>
__device__ Vec3<S> field_vjp(const FieldArrays<S>& f, const WarpMlp<S>& m, Vec3<S> x, Vec3<S> drho, bool active,
                             int lane, Stage<S>& stage, WeightSums<S>& weights, const Adder<S, kExact>& table,
                             bool positions) {
  using At = Stage<S>;
  encode(f, grid_position(f, x), active, stage.row(lane) + At::kX);
  *reinterpret_cast<Entry<S>*>(stage.row(lane) + At::kD) = {{drho.x, drho.y, drho.z, S(0)}};
  *reinterpret_cast<Entry<S>*>(stage.row(lane) + At::kPoint) = {{x.x, x.y, x.z, S(0)}};  // saves registers
  __syncwarp();
  const auto column = [&](int first) { return [&stage, first](int p) { return stage.row(p) + first; }; };
  Rows<S> g;
  {
    const Rows<S> h1 = rectified(layer(load_rows<S>(lane, column(At::kX)), m.w1, lane));
    store_rows(h1, lane, column(At::kH1));
    const Rows<S> h2 = rectified(layer(h1, m.w2, lane));
    Vec3<S> d[4];
    BT_UNROLL
    for (int i = 0; i < 4; ++i) d[i] = load3(stage.row(8 * i + lane / 4) + At::kD);
    weights.add_last(h2, d);
    BT_UNROLL
    for (int k = 0; k < 4; ++k) {
      const Vec3<S> w = load3(m.output[k / 2 * 8 + lane % 4 * 2 + k % 2]);
      BT_UNROLL
      for (int i = 0; i < 4; ++i) g.v[i / 2][k / 2][i % 2 * 2 + k % 2] = dot(w, d[i]);
    }
    g = where_open(g, h2);
  }
  store_rows(g, lane, column(At::kG2));
  __syncwarp();
  g = where_open(layer(g, m.w2t, lane), load_rows<S>(lane, column(At::kH1)));
  store_rows(g, lane, column(At::kG1));
  g = layer(g, m.w1t, lane);
  __syncwarp();
  weights.add_outer(weights.w1, stage.number + At::kX, stage.number + At::kG1, At::kColumns, lane);
  weights.add_outer(weights.w2, stage.number + At::kH1, stage.number + At::kG2, At::kColumns, lane);
  x = load3(stage.row(lane) + At::kPoint);
  __syncwarp();
  store_rows(g, lane, [&](int p) { return stage.feature_gradients(p); });
  const Vec3<S> dc = encode_vjp(f, grid_position(f, x), active, lane, stage, table, positions);
  __syncwarp();  // before the next look-ups overwrite what is read here
  if (!positions || !active) return {S(0), S(0), S(0)};
  return grid_coordinate_vjp(x, load3(f.mid), f.half, f.contract, dc);
}

// ---- blocks of a backward pass

template <class S> constexpr int kBackwardWarps = sizeof(S) == 4 ? 4 : 2;  // a warp's stage is 9 KB, or 18 KB in double
template <class S> constexpr int kBackwardResident = sizeof(S) == 4 ? 4 : 2;  // resident blocks per multiprocessor

constexpr int kChunk = 8 * kWarp;  // consecutive points that a warp takes at a time

template <class S> struct BackwardShared {
  WarpMlp<S> mlp;
  Stage<S> stage[kBackwardWarps<S>];
};

// Adds up the block's warps in order into its row of `out`.
template <class S>
__device__ void store_weight_sums(BackwardShared<S>& shared, WeightSums<S>& weights, int warp, int lane, S* out) {
  constexpr int kThreads = kBackwardWarps<S> * kWarp;
  static_assert(kMlpWeights <= kWarp * Stage<S>::kColumns, "the sums reuse the first warp's stage");
  S* sums = shared.stage[0].number;
  __syncthreads();
  for (int k = threadIdx.x; k < kMlpWeights; k += kThreads) sums[k] = S(0);
  __syncthreads();
  for (int w = 0; w < kBackwardWarps<S>; ++w) {
    if (w == warp) weights.add_to(sums, lane);
    __syncthreads();
  }
  for (int k = threadIdx.x; k < kMlpWeights; k += kThreads) out[int64_t(blockIdx.x) * kMlpWeights + k] = sums[k];
}

// Returns the blocks of a backward pass over n points, a function of n alone, which fixes the order of all sums.
template <class S> int backward_blocks(int64_t n) {
  const int64_t blocks = ceil_div(n, int64_t(kChunk) * kBackwardWarps<S>);
  return int(blocks < 1 ? 1 : blocks > kMostBlocks ? kMostBlocks : blocks);
}

// ---- kernels

constexpr int kThreads = 128;

template <class S>
__global__ void __launch_bounds__(kThreads)
    field_forward_kernel(int64_t n, FieldArrays<S> field, const S* __restrict__ x, S* __restrict__ rho) {
  __shared__ ForwardMlp<S> m;
  __shared__ ForwardStage<S> stage[kThreads / kWarp];
  load_mlp(field, threadIdx.x, kThreads, m);
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  Vec3<S> at = {S(0), S(0), S(0)};
  if (i < n) at = load3(x + 3 * i);
  const Vec3<S> value = evaluate(field, m, at, i < n, lane, stage[warp]);
  if (i < n) store3(rho + 3 * i, value);
}

// Warps take chunks of consecutive points in turn.
template <class S, bool kExact>
__global__ void __launch_bounds__(kBackwardWarps<S>* kWarp, kBackwardResident<S>)
    field_backward_kernel(int64_t n, FieldArrays<S> field, const S* __restrict__ x, const S* __restrict__ drho,
                          S* dtable, ExactSums exact, S* partial, S* dx) {
  BT_DYNAMIC_SHARED(BackwardShared<S>, shared);
  load_mlp(field, threadIdx.x, kBackwardWarps<S> * kWarp, shared->mlp);
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t step = int64_t(gridDim.x) * kBackwardWarps<S> * kChunk;
  const Adder<S, kExact> table = adder<kExact>(dtable, exact);
  WeightSums<S> weights;
  for (int64_t chunk = (int64_t(blockIdx.x) * kBackwardWarps<S> + warp) * kChunk; chunk < n; chunk += step)
    for (int64_t first = chunk; first < chunk + kChunk && first < n; first += kWarp) {
      const int64_t i = first + lane;
      const bool active = i < n;
      const Vec3<S> zero = {S(0), S(0), S(0)};
      const Vec3<S> at = active ? load3(x + 3 * i) : zero, d = active ? load3(drho + 3 * i) : zero;
      const Vec3<S> g =
          field_vjp(field, shared->mlp, at, d, active, lane, shared->stage[warp], weights, table, dx != nullptr);
      if (dx && active) store3(dx + 3 * i, g);
    }
  store_weight_sums(*shared, weights, warp, lane, partial);
}

// Adds up the blocks' weight gradients. 32 columns per block: 8 groups of threads sum rows, then the groups are added
// in order.
constexpr int kSumThreads = 256, kSumRows = kSumThreads / kWarp;
template <class S>
__global__ void __launch_bounds__(kSumThreads)
    sum_weights_kernel(const S* partial, int blocks, int levels, FieldGradients<S> out) {
  __shared__ S sums[kSumRows][kWarp];
  const int column = int(blockIdx.x) * kWarp + int(threadIdx.x) % kWarp, group = int(threadIdx.x) / kWarp;
  S total = S(0);
  if (column < kMlpWeights)
    for (int b = group; b < blocks; b += kSumRows) total += partial[int64_t(b) * kMlpWeights + column];
  sums[group][threadIdx.x % kWarp] = total;
  __syncthreads();
  if (group || column >= kMlpWeights) return;
  for (int g = 1; g < kSumRows; ++g) total += sums[g][threadIdx.x];
  constexpr int kMatrix = kWidth * kWidth;
  if (column < levels * kFeatures * kWidth) out.w1[column] = total;
  if (column >= kMatrix && column < 2 * kMatrix) out.w2[column - kMatrix] = total;
  if (column >= 2 * kMatrix) out.w3[column - 2 * kMatrix] = total;
}
}  // namespace

template <class S> void field_forward(const FieldForward<S>& a, Stream stream) {
  BT_LAUNCH_EACH(field_forward_kernel<S>, a.n, kThreads, stream, a.n, *a.field, a.x, a.rho);
}

template <class S> void field_backward(const FieldBackward<S>& a, Stream stream) {
  const FieldArrays<S>& field = *a.field;
  S* const dtable = a.dfield.table;
  const int64_t entries = field.table_size();
  const int blocks = backward_blocks<S>(a.n);
  const size_t shared = sizeof(BackwardShared<S>);
  ExactSums exact;
  if (a.exact)
    exact = begin_exact(a.exact, entries, &field, a.n, 3 * a.n, a.drho, stream);
  else
    fill_zero(dtable, entries, stream);
  const auto kernel = a.exact ? field_backward_kernel<S, true> : field_backward_kernel<S, false>;
  BT_ALLOW_SHARED(kernel, shared);
  BT_LAUNCH(kernel, dim3(blocks), dim3(kBackwardWarps<S> * kWarp), shared, stream, a.n, field, a.x, a.drho, dtable,
            exact, a.mlp, a.dx);
  if (a.exact) end_exact(exact, entries, dtable, stream);
  BT_LAUNCH(sum_weights_kernel<S>, dim3(unsigned(ceil_div(kMlpWeights, kWarp))), dim3(kSumThreads), 0, stream, a.mlp,
            blocks, field.levels, a.dfield);
}

BT_INSTANTIATE(field_forward, FieldForward)
BT_INSTANTIATE(field_backward, FieldBackward)

}  // namespace bt::cuda
