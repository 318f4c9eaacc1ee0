// Colours of fragments. Fragments of small weight have no residual, in trained scenes about half of them: a warp
// collects the others in a queue in shared memory and looks up the field for 32 at a time, with all lanes at work. The
// list is in the order of tile and surfel, so a surfel's fragments in a tile are neighbours: they share cells of the
// field, and their gradients are added up within the warp before they go to memory.
#include "core/shading.h"
#include "cuda/field_device.h"

namespace bt::cuda {

// Where the backward kernel writes.
template <class S>
struct ShadeGradients {
  S *base, *table, *uv, *frames;
  S* partial;  // of the MLP's weights
};

namespace {
constexpr int kForwardWarps = 4;
template <class S>
constexpr int kForwardResident = sizeof(S) == 4 ? 6 : 2;  // blocks at a time on a multiprocessor
constexpr int64_t kMostForwardBlocks = 6 * 132;           // one round of them on an H100

// Puts the item of every lane that has one at the end of the queue, in the order of the lanes.
__device__ void put(int64_t* queue, int& count, bool has, int64_t item, int lane) {
  const unsigned votes = __ballot_sync(kFullMask, has);
  if (has) queue[count + count_below(votes, lane)] = item;
  count += __popc(votes);
  __syncwarp();
}
// Takes up to 32 items from the front.
__device__ void drop(int64_t* queue, int& count, int lane) {
  const int rest = count > kWarp ? count - kWarp : 0;
  const int64_t later = lane < rest ? queue[kWarp + lane] : 0;
  __syncwarp();
  if (lane < rest) queue[lane] = later;
  __syncwarp();
  count = rest;
}

template <class S>
__device__ Vec3<S> fragment_point(const FragmentArrays<S>& f, const S* frames, int64_t i) {
  return world_point(frames + int64_t(f.surfel[i]) * kFrame, f.uv[i], f.uv[f.total + i]);
}

template <class S>
struct ForwardShared {
  WarpMlp<S> mlp;
  ForwardStage<S> stage[kForwardWarps];
  int64_t queue[kForwardWarps][2 * kWarp];
};
template <class S>
__global__ void __launch_bounds__(kForwardWarps* kWarp, kForwardResident<S>)
    forward_kernel(FragmentArrays<S> f, S bound, const S* __restrict__ base, const S* __restrict__ frames,
                   FieldArrays<S> field, S* __restrict__ colors) {
  __shared__ ForwardShared<S> shared;
  const bool textured = field.levels > 0;
  if (textured) load_mlp(field, threadIdx.x, kForwardWarps * kWarp, shared.mlp);
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t step = int64_t(gridDim.x) * kForwardWarps * kChunk;
  int64_t chunk = (int64_t(blockIdx.x) * kForwardWarps + warp) * kChunk, first = chunk;
  int64_t* queue = shared.queue[warp];
  int count = 0;
  while (first < f.total) {
    const int64_t i = first + lane;
    const bool in = i < f.total, looks_up = in && textured && f.weight[i] >= bound;
    if (in && !looks_up) {
      store3(colors + 3 * i, view_base(load3(base + 3 * int64_t(f.surfel[i]))));
    }
    put(queue, count, looks_up, i, lane);
    first += kWarp;
    if (first == chunk + kChunk) first = chunk += step;
    while (count >= kWarp || (count && first >= f.total)) {
      const bool active = lane < count;
      const int64_t j = active ? queue[lane] : 0;
      Vec3<S> x = {S(0), S(0), S(0)};
      if (active) x = fragment_point(f, frames, j);
      const Vec3<S> rho = evaluate(field, shared.mlp, x, active, lane, shared.stage[warp]);
      if (active) store3(colors + 3 * j, shaded(view_base(load3(base + 3 * int64_t(f.surfel[j]))), rho));
      drop(queue, count, lane);
    }
  }
}

// Adds M numbers of every lane to rows of width M, one addition per run of lanes with the same row. Row -1: none.
template <int M, class S, bool kExact>
__device__ void add_to_rows(int32_t row, int lane, S (&value)[M], const Adder<S, kExact>& to) {
  const unsigned run = run_of(row, lane);
  sum_over_run(run, lane, value);
  if (row < 0 || count_below(run, lane)) return;
  BT_UNROLL
  for (int k = 0; k < M; ++k) to.add(int64_t(row) * M + k, value[k]);
}

// kLearn: the field gets gradients, too.
template <class S, bool kExact, bool kLearn>
__global__ void __launch_bounds__(kBackwardWarps<S>* kWarp, kBackwardResident<S>)
    backward_kernel(FragmentArrays<S> f, S bound, const S* __restrict__ base, const S* __restrict__ frames,
                    FieldArrays<S> field, const S* __restrict__ colors, const S* __restrict__ dcolors,
                    ShadeGradients<S> out, ExactSums exact) {
  constexpr int kWarps = kBackwardWarps<S>;
  BT_DYNAMIC_SHARED(BackwardShared<S>, shared);
  if constexpr (kLearn) load_mlp(field, threadIdx.x, kWarps * kWarp, shared->mlp);
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  Adder<S, kExact> dbase, dtable, dframes;
  if constexpr (kExact) {
    dbase = {exact.base, exact.range->base}, dtable = {exact.table, exact.range->table};
    dframes = {exact.frames, exact.range->frames};
  } else {
    dbase = {out.base}, dtable = {out.table}, dframes = {out.frames};
  }
  WeightSums<S> weights;
  int count = 0;
  const int64_t step = int64_t(gridDim.x) * kWarps * kChunk;
  const int64_t begin = (int64_t(blockIdx.x) * kWarps + warp) * kChunk;

  const auto look_up = [&] {
    const bool active = lane < count;
    const int64_t j = active ? shared->queue[warp][lane] : 0;
    const Vec3<S> zero = {S(0), S(0), S(0)};
    Vec3<S> x = zero, d = zero;
    if (active) {
      x = fragment_point(f, frames, j);
      d = residual_gradient(load3(colors + 3 * j), load3(dcolors + 3 * j));
    }
    const bool moves = out.uv != nullptr;
    const Vec3<S> dx = learn(field, shared->mlp, x, d, active, lane, shared->stage[warp], weights, dtable, moves);
    if (moves) {
      S g[kFrame] = {};
      if (active) {
        const S* frame = frames + int64_t(f.surfel[j]) * kFrame;
        world_point_vjp(frame, f.uv[j], f.uv[f.total + j], dx, out.uv[j], out.uv[f.total + j], g);
      }
      add_to_rows(active ? f.surfel[j] : -1, lane, g, dframes);
    }
    drop(shared->queue[warp], count, lane);
  };

  int64_t chunk = begin, first = begin;
  while (first < f.total) {
    const int64_t i = first + lane;
    const bool in = i < f.total;
    const int32_t surfel = in ? f.surfel[i] : -1;
    S g[3] = {};
    if (in)
      store3(g, base_gradient(load3(base + 3 * int64_t(surfel)),
                              residual_gradient(load3(colors + 3 * i), load3(dcolors + 3 * i))));
    add_to_rows(surfel, lane, g, dbase);
    first += kWarp;
    if (first == chunk + kChunk) first = chunk += step;
    if constexpr (kLearn) {
      const bool looks_up = in && f.weight[i] >= bound;
      if (in && !looks_up && out.uv) out.uv[i] = out.uv[f.total + i] = S(0);
      put(shared->queue[warp], count, looks_up, i, lane);
      while (count >= kWarp || (count && first >= f.total)) look_up();
    }
  }
  if constexpr (kLearn) give_weights(*shared, weights, warp, lane, out.partial);
}
}  // namespace

template <class S>
void shade_forward(const ShadeForward<S>& a, Stream stream) {
  if (!a.f.total) return;
  FieldArrays<S> none = {};
  const int64_t blocks = ceil_div(a.f.total, kChunk * kForwardWarps);
  BT_LAUNCH(forward_kernel<S>, dim3(unsigned(blocks < kMostForwardBlocks ? blocks : kMostForwardBlocks)),
            dim3(kForwardWarps * kWarp), 0, stream, a.f, a.bound, a.base, a.frames, a.field ? *a.field : none,
            a.colors);
}

template <class S>
void shade_backward(const ShadeBackward<S>& a, Stream stream) {
  const bool learns = a.learns();
  const FieldArrays<S>* learned = learns ? a.field : nullptr;
  FieldArrays<S> arrays = {};
  if (learns) arrays = *a.field;
  const ShadeGradients<S> out = {a.dbase, learns ? a.dfield.table : nullptr, a.duv, a.dframes, a.work.mlp};
  // without the field a block's threads need few registers and wait for memory: more of them
  const int blocks = backward_blocks<S>(a.f.total, learns ? kMostBlocks : 4 * kMostBlocks);
  const size_t shared = learns ? sizeof(BackwardShared<S>) : 0;
  const dim3 grid(blocks), block(kBackwardWarps<S> * kWarp);
  const auto run = [&](auto kernel, const ExactSums& exact) {
    BT_ALLOW_SHARED(kernel, shared);
    BT_LAUNCH(kernel, grid, block, shared, stream, a.f, a.bound, a.base, a.frames, arrays, a.colors, a.dcolors, out,
              exact);
  };
  if (a.work.exact) {
    const ExactSums exact = begin_exact(a.work, learned, a.n, a.dframes != nullptr, a.f.total, a.dcolors, stream);
    learns ? run(backward_kernel<S, true, true>, exact) : run(backward_kernel<S, true, false>, exact);
    end_exact(exact, learned, a.n, out.table, a.dbase, a.dframes, stream);
  } else {
    fill_zero(a.dbase, 3 * a.n, stream);
    if (a.dframes) fill_zero(a.dframes, kFrame * a.n, stream);
    if (learns) fill_zero(out.table, arrays.table_size(), stream);
    learns ? run(backward_kernel<S, false, true>, ExactSums()) : run(backward_kernel<S, false, false>, ExactSums());
  }
  if (learns) sum_weights(a.work.mlp, blocks, arrays.levels, a.dfield, stream);
}

#define BT_INSTANTIATE(S)                                      \
  template void shade_forward(const ShadeForward<S>&, Stream); \
  template void shade_backward(const ShadeBackward<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
