// Colours of fragments. Fragments of small weight have no residual, in trained scenes about half of them: a warp
// collects the others in a queue in shared memory and looks up the field for 32 at a time, with all lanes at work. The
// list is in the order of tile and surfel, so a surfel's fragments in a tile are neighbours: they share cells of the
// field, and their gradients are added up within the warp before they go to memory.
#include "core/shading.h"
#include "cuda/field_device.h"

namespace bt::cuda {

// Outputs of the backward kernel.
template <class S> struct ShadeGradients {
  S *base, *table, *uv, *frames;
  S* partial;  // of the MLP's weights
};

namespace {
constexpr int kForwardWarps = 4;
template <class S> constexpr int kForwardResident = sizeof(S) == 4 ? 8 : 2;  // blocks at a time on a multiprocessor
constexpr int64_t kMostForwardBlocks = 8 * 132;                              // one round of them on an H100

// A block's items by number, which 32 bits hold: those of kWarps neighbouring chunks, then those a grid further on.
template <int kWarps> __device__ int64_t item(uint32_t number) {
  const uint32_t chunk = number / kChunk;
  return ((int64_t(chunk / kWarps) * gridDim.x + blockIdx.x) * kWarps + chunk % kWarps) * kChunk + number % kChunk;
}
// The next of the block's chunks that no warp has taken, so that warps with many look-ups take fewer chunks. Exact sums
// need a fixed order: their warps take chunks in turn.
__device__ uint32_t take_chunk(uint32_t* taken, int lane) {
  const uint32_t chunk = lane == 0 ? atomicAdd(taken, 1u) : 0u;
  return __shfl_sync(kFullMask, chunk, 0);
}

// Puts the item of every lane that has one at the end of the queue, in the order of the lanes.
__device__ void put(uint32_t* queue, int& count, bool has, uint32_t number, int lane) {
  const unsigned votes = __ballot_sync(kFullMask, has);
  if (has) queue[count + count_below(votes, lane)] = number;
  count += __popc(votes);
}
// Takes the items from the front that were looked up; fewer than 32 are left.
__device__ void drop(uint32_t* queue, int& count, int looked_up, int lane) {
  const int rest = count > looked_up ? count - looked_up : 0;
  const uint32_t later = lane < rest ? queue[looked_up + lane] : 0u;
  __syncwarp();
  if (lane < rest) queue[lane] = later;
  __syncwarp();
  count = rest;
}

template <class S> __device__ Vec3<S> fragment_point(const FragmentArrays<S>& f, const S* frames, int64_t i) {
  return world_point(frames + int64_t(f.surfel[i]) * kFrame, f.uv[i], f.uv[f.total + i]);
}

template <class S> struct ForwardShared {
  ForwardMlp<S> mlp;
  ForwardStage<S> stage[kForwardWarps];
  uint32_t queue[kForwardWarps][kQueue];
  uint32_t taken;  // chunks
};
template <class S>
__global__ void __launch_bounds__(kForwardWarps* kWarp, kForwardResident<S>)
    forward_kernel(FragmentArrays<S> f, S bound, const S* __restrict__ base, const S* __restrict__ frames,
                   FieldArrays<S> field, S* __restrict__ colors) {
  __shared__ ForwardShared<S> shared;
  const bool textured = field.levels > 0;
  if (threadIdx.x == 0) shared.taken = kForwardWarps;
  if (textured)
    load_mlp(field, threadIdx.x, kForwardWarps * kWarp, shared.mlp);
  else
    __syncthreads();
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  uint32_t* queue = shared.queue[warp];
  uint32_t next = uint32_t(warp) * kChunk;  // item
  int count = 0;
  for (bool more = true; more || count;) {
    const int64_t first = item<kForwardWarps>(next);
    more = first < f.total;
    if (more) {
      // all lanes read, the last ones what others read, so that the reads of a step are on their way together
      int32_t surfel[kStep / kWarp];
      bool in[kStep / kWarp], looks_up[kStep / kWarp];
      BT_UNROLL
      for (int k = 0; k < kStep / kWarp; ++k) {
        const int64_t i = first + k * kWarp + lane;
        in[k] = i < f.total;
        const int64_t j = in[k] ? i : f.total - 1;
        surfel[k] = f.surfel[j];
        looks_up[k] = in[k] && textured && f.weight[j] >= bound;
      }
      BT_UNROLL
      for (int k = 0; k < kStep / kWarp; ++k) {
        if (in[k] && !looks_up[k])
          store3(colors + 3 * (first + k * kWarp + lane), view_base(load3(base + 3 * int64_t(surfel[k]))));
        put(queue, count, looks_up[k], next + k * kWarp + lane, lane);
      }
      __syncwarp();
      next += kStep;
      if (next % kChunk == 0) next = take_chunk(&shared.taken, lane) * kChunk;
    }
    int looked_up = 0;
    while (count - looked_up >= kWarp || (!more && looked_up < count)) {
      const bool active = looked_up + lane < count;
      const auto mine = [&] { return item<kForwardWarps>(queue[looked_up + lane]); };
      Vec3<S> x = {S(0), S(0), S(0)};
      if (active) x = fragment_point(f, frames, mine());
      const Vec3<S> rho = evaluate(field, shared.mlp, x, active, lane, shared.stage[warp]);
      if (active) {
        const int64_t j = mine();
        store3(colors + 3 * j, shaded(view_base(load3(base + 3 * int64_t(f.surfel[j]))), rho));
      }
      looked_up += kWarp;
    }
    if (looked_up) drop(queue, count, looked_up, lane);
  }
}

// kTrainsField: the field gets gradients, too.
template <class S, bool kExact, bool kTrainsField>
__global__ void __launch_bounds__(kBackwardWarps<S>* kWarp, kBackwardResident<S>)
    backward_kernel(FragmentArrays<S> f, S bound, const S* __restrict__ base, const S* __restrict__ frames,
                    FieldArrays<S> field, const S* __restrict__ colors, const S* __restrict__ dcolors,
                    ShadeGradients<S> out, ExactSums exact) {
  constexpr int kWarps = kBackwardWarps<S>;
  BT_DYNAMIC_SHARED(BackwardShared<S>, shared);
  if constexpr (kTrainsField) {
    if (threadIdx.x == 0) shared->taken = kWarps;
    load_mlp(field, threadIdx.x, kWarps * kWarp, shared->mlp);
  }
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  Adder<S, kExact> dbase, dtable, dframes;
  if constexpr (kExact) {
    dbase = {exact.base, exact.range->base}, dtable = {exact.table, exact.range->table};
    dframes = {exact.frames, exact.range->frames};
  } else {
    dbase = {out.base}, dtable = {out.table}, dframes = {out.frames};
  }
  WeightSums<S> weights;
  int count = 0, looked_up = 0;

  const auto look_up = [&] {
    const bool active = looked_up + lane < count;
    // read again later, as registers are scarce until then
    const auto mine = [&] { return item<kWarps>(shared->queue[warp][looked_up + lane]); };
    const Vec3<S> zero = {S(0), S(0), S(0)};
    Vec3<S> x = zero, d = zero;
    if (active) {
      const int64_t j = mine();
      x = fragment_point(f, frames, j);
      d = residual_gradient(load3(colors + 3 * j), load3(dcolors + 3 * j));
    }
    const bool moves = out.uv != nullptr;
    const Vec3<S> dx = field_vjp(field, shared->mlp, x, d, active, lane, shared->stage[warp], weights, dtable, moves);
    if (moves) {
      S g[kFrame] = {};
      int32_t surfel = -1;
      if (active) {
        const int64_t j = mine();
        surfel = f.surfel[j];
        world_point_vjp(frames + int64_t(surfel) * kFrame, f.uv[j], f.uv[f.total + j], dx, out.uv[j],
                        out.uv[f.total + j], g);
      }
      add_to_rows(surfel, lane, g, dframes);
    }
    looked_up += kWarp;
  };

  uint32_t next = uint32_t(warp) * kChunk;  // item
  for (bool more = true; more || count;) {
    const int64_t first = item<kWarps>(next);
    more = first < f.total;
    if (more) {
      // as in the forward kernel
      constexpr int kRows = kStep / kWarp;
      int32_t surfel[kRows];
      bool textured[kRows];
      Vec3<S> d[kRows], f_view[kRows];
      BT_UNROLL
      for (int k = 0; k < kRows; ++k) {
        const int64_t i = first + k * kWarp + lane, j = i < f.total ? i : f.total - 1;
        surfel[k] = f.surfel[j];
        if constexpr (kTrainsField) textured[k] = f.weight[j] >= bound;
        d[k] = residual_gradient(load3(colors + 3 * j), load3(dcolors + 3 * j));
      }
      BT_UNROLL
      for (int k = 0; k < kRows; ++k) f_view[k] = load3(base + 3 * int64_t(surfel[k]));
      BT_UNROLL
      for (int k = 0; k < kRows; ++k) {
        const int64_t i = first + k * kWarp + lane;
        const bool in = i < f.total;
        S g[3] = {};
        if (in) store3(g, base_gradient(f_view[k], d[k]));
        add_to_rows(in ? surfel[k] : -1, lane, g, dbase);
        if constexpr (kTrainsField) {
          const bool looks_up = in && textured[k];
          if (in && !looks_up && out.uv) out.uv[i] = out.uv[f.total + i] = S(0);
          put(shared->queue[warp], count, looks_up, next + k * kWarp + lane, lane);
        }
      }
      __syncwarp();
      next += kStep;
      if (next % kChunk == 0) {
        if constexpr (kTrainsField && !kExact)
          next = take_chunk(&shared->taken, lane) * kChunk;
        else
          next += (kWarps - 1) * kChunk;
      }
    }
    if constexpr (kTrainsField) {
      while (count - looked_up >= kWarp || (!more && looked_up < count)) look_up();
      if (looked_up) drop(shared->queue[warp], count, looked_up, lane);
      looked_up = 0;
    }
  }
  if constexpr (kTrainsField) store_weight_sums(*shared, weights, warp, lane, out.partial);
}
}  // namespace

template <class S> void shade_forward(const ShadeForward<S>& a, Stream stream) {
  if (!a.f.total) return;
  FieldArrays<S> none = {};
  const int64_t blocks = ceil_div(a.f.total, kChunk * kForwardWarps);
  BT_LAUNCH(forward_kernel<S>, dim3(unsigned(blocks < kMostForwardBlocks ? blocks : kMostForwardBlocks)),
            dim3(kForwardWarps * kWarp), 0, stream, a.f, a.bound, a.base, a.frames, a.field ? *a.field : none,
            a.colors);
}

template <class S> void shade_backward(const ShadeBackward<S>& a, Stream stream) {
  const bool trains_field = a.trains_field();
  const FieldArrays<S>* learned = trains_field ? a.field : nullptr;
  FieldArrays<S> arrays = {};
  if (trains_field) arrays = *a.field;
  const ShadeGradients<S> out = {a.dbase, trains_field ? a.dfield.table : nullptr, a.duv, a.dframes, a.work.mlp};
  // without the field a block's threads need few registers and wait for memory: more of them
  const int blocks = backward_blocks<S>(a.f.total, trains_field ? kMostBlocks : 4 * kMostBlocks);
  const size_t shared = trains_field ? sizeof(BackwardShared<S>) : 0;
  const dim3 grid(blocks), block(kBackwardWarps<S> * kWarp);
  const auto run = [&](auto kernel, const ExactSums& exact) {
    BT_ALLOW_SHARED(kernel, shared);
    BT_LAUNCH(kernel, grid, block, shared, stream, a.f, a.bound, a.base, a.frames, arrays, a.colors, a.dcolors, out,
              exact);
  };
  if (a.work.exact) {
    const ExactSums exact = begin_exact(a.work.exact, learned ? learned->table_size() : 0, learned, a.n,
                                        a.dframes != nullptr, a.f.total, 3 * a.f.total, a.dcolors, stream);
    trains_field ? run(backward_kernel<S, true, true>, exact) : run(backward_kernel<S, true, false>, exact);
    end_exact(exact, arrays.table_size(), a.n, out.table, a.dbase, a.dframes, stream);
  } else {
    fill_zero(a.dbase, 3 * a.n, stream);
    if (a.dframes) fill_zero(a.dframes, kFrame * a.n, stream);
    if (trains_field) fill_zero(out.table, arrays.table_size(), stream);
    trains_field ? run(backward_kernel<S, false, true>, ExactSums())
                 : run(backward_kernel<S, false, false>, ExactSums());
  }
  if (trains_field) sum_weights(a.work.mlp, blocks, arrays.levels, a.dfield, stream);
}

#define BT_INSTANTIATE(S)                                      \
  template void shade_forward(const ShadeForward<S>&, Stream); \
  template void shade_backward(const ShadeBackward<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
