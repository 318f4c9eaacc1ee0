// The field's MLP by warps: the layers of 32 look-ups are products of a 32 x 16 and a 16 x 16 matrix, composed of 16 x
// 8 by 8 x 8 products, each one step of the tensor cores (mma.m16n8k8).
//
// Their hardware layout in a warp, with g = lane / 4 and t = lane % 4: a lane holds
//   of the first factor the numbers (g, t), (g + 8, t), (g, t + 4), (g + 8, t + 4),
//   of the second factor (t, g), (t + 4, g),
//   of the product (g, 2t), (g, 2t + 1), (g + 8, 2t), (g + 8, 2t + 1).
// The inner indices held at t and t + 4 may be any two, if both factors agree. With 2t and 2t + 1, a lane's numbers of
// a product are its numbers of the next layer's first factor, so layers chain in registers.
#pragma once

#include <type_traits>

#include "core/field.h"
#include "cuda/warp.h"

namespace bt::cuda {

#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
template <class S> constexpr bool kTensorCores = std::is_same_v<S, float>;
#else
template <class S> constexpr bool kTensorCores = false;
#endif

// A lane's N numbers of a factor. Tensor cores use the first 11 bits of a float: each number is split into high + low
// of 11 bits each, with an error of at most 2^-20 of it.
template <class S, int N> struct alignas(16) Factor {
  S high[N], low[N];
};
template <class S, int N> __device__ Factor<S, N> factor(const S (&v)[N]) {
  Factor<S, N> f;
  BT_UNROLL
  for (int i = 0; i < N; ++i) {
#if defined(__CUDA_ARCH__)
    if constexpr (kTensorCores<S>)
      f.high[i] = __uint_as_float(__float_as_uint(v[i]) & 0xffffe000u);
    else
#endif
      f.high[i] = v[i];
    f.low[i] = v[i] - f.high[i];
  }
  return f;
}

#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
__device__ inline void tensor_step(float (&c)[4], const float (&a)[4], const float (&b)[2]) {
  asm volatile(
      "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])), "r"(__float_as_uint(a[3])),
        "r"(__float_as_uint(b[0])), "r"(__float_as_uint(b[1])));
}
#endif

// Computes c += a b. In float by three products on tensor cores, small ones first (low low is below the error of low);
// in double, on older GPUs and in the emulator by shuffles.
template <class S> __device__ void multiply_add(S (&c)[4], const Factor<S, 4>& a, const Factor<S, 2>& b, int lane) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  if constexpr (kTensorCores<S>) {
    tensor_step(c, a.low, b.high);
    tensor_step(c, a.high, b.low);
    tensor_step(c, a.high, b.high);
    return;
  }
#endif
  const int row = lane / 4 * 4, column = lane % 4 * 8;
  BT_UNROLL
  for (int s = 0; s < 8; ++s) {
    const S a0 = __shfl_sync(kFullMask, a.high[s / 4 * 2], row + s % 4);
    const S a1 = __shfl_sync(kFullMask, a.high[s / 4 * 2 + 1], row + s % 4);
    const S b0 = __shfl_sync(kFullMask, b.high[s / 4], column + s % 4);
    const S b1 = __shfl_sync(kFullMask, b.high[s / 4], column + 4 + s % 4);
    c[0] += a0 * b0, c[1] += a0 * b1, c[2] += a1 * b0, c[3] += a1 * b1;
  }
}

// 32 x 16 numbers, a row per look-up, in product layout: v[m][n] has the rows from 16 m and the columns from 8 n.
template <class S> struct Rows {
  S v[2][2][4];
  // Calls take(look-up, column, two neighbours) for each of the lane's pairs.
  template <class F> __device__ void pairs(int lane, const F& take) {
    BT_UNROLL
    for (int m = 0; m < 2; ++m) {
      BT_UNROLL
      for (int n = 0; n < 2; ++n) {
        const int row = 16 * m + lane / 4, column = 8 * n + lane % 4 * 2;
        take(row, column, v[m][n]);
        take(row + 8, column, v[m][n] + 2);
      }
    }
  }
  template <class F> __device__ void each(const F& change) {
    BT_UNROLL
    for (int i = 0; i < 16; ++i) change(v[i / 8][i / 4 % 2][i % 4], i);
  }
};
template <class S> struct alignas(2 * sizeof(S)) Pair {
  S v[2];
};
// Loads and stores, where row(p) is the memory of look-up p.
template <class S, class Row> __device__ Rows<S> load_rows(int lane, const Row& row) {
  Rows<S> r;
  r.pairs(lane, [&](int p, int column, S* v) {
    const Pair<S> pair = *reinterpret_cast<const Pair<S>*>(row(p) + column);
    v[0] = pair.v[0], v[1] = pair.v[1];
  });
  return r;
}
template <class S, class Row> __device__ void store_rows(Rows<S> r, int lane, const Row& row) {
  r.pairs(lane, [&](int p, int column, const S* v) { *reinterpret_cast<Pair<S>*>(row(p) + column) = {{v[0], v[1]}}; });
}
template <class S> __device__ Rows<S> rectified(Rows<S> r) {
  r.each([](S& v, int) { v = relu(v); });
  return r;
}
// Returns r where a layer's output is positive, else 0.
template <class S> __device__ Rows<S> where_open(Rows<S> r, const Rows<S>& output) {
  r.each([&](S& v, int i) { v = output.v[i / 8][i / 4 % 2][i % 4] > S(0) ? v : S(0); });
  return r;
}

// N / 8 column tiles of a matrix with 16 rows, as second factors: tile[j][n] has the rows from 8 j.
template <class S, int kTiles> struct Weights {
  Factor<S, 2> tile[2][kTiles][kWarp];
};
// Weights in shared memory; for gradients also their transposes, and w3 itself.
template <class S> struct ForwardMlp {
  Weights<S, 2> w1, w2;
  Weights<S, 1> w3;
};
template <class S> struct WarpMlp : ForwardMlp<S> {
  Weights<S, 2> w1t, w2t;
  alignas(16) S output[kWidth][4];
};

// Loads the weights by all threads of the block; ends with a barrier. M: one of the two above.
template <class S, class M> __device__ void load_mlp(const FieldArrays<S>& f, int thread, int threads, M& m) {
  constexpr bool kGradients = std::is_same_v<M, WarpMlp<S>>;
  const int inputs = f.levels * kFeatures;
  for (int k = thread; k < 2 * 2 * kWarp; k += threads) {
    const int j = k / kWarp / 2, n = k / kWarp % 2, lane = k % kWarp;
    const int from = 8 * j + lane % 4 * 2, to = 8 * n + lane / 4;
    const auto put = [&](Factor<S, 2>& tile, S first, S second) {
      const S v[2] = {first, second};
      tile = factor(v);
    };
    const S* w1 = f.w1;
    put(m.w1.tile[j][n][lane], from < inputs ? w1[from * kWidth + to] : S(0),
        from < inputs ? w1[(from + 1) * kWidth + to] : S(0));
    if constexpr (kGradients) {
      put(m.w1t.tile[j][n][lane], to < inputs ? w1[to * kWidth + from] : S(0),
          to < inputs ? w1[to * kWidth + from + 1] : S(0));
      put(m.w2t.tile[j][n][lane], f.w2[to * kWidth + from], f.w2[to * kWidth + from + 1]);
    }
    put(m.w2.tile[j][n][lane], f.w2[from * kWidth + to], f.w2[(from + 1) * kWidth + to]);
    if (n == 0)
      put(m.w3.tile[j][0][lane], to < 3 ? f.w3[3 * from + to] : S(0), to < 3 ? f.w3[3 * (from + 1) + to] : S(0));
  }
  if constexpr (kGradients) {
    for (int k = thread; k < 4 * kWidth; k += threads)
      m.output[k / 4][k % 4] = k % 4 < 3 ? f.w3[k / 4 * 3 + k % 4] : S(0);
  }
  __syncthreads();
}

// Computes c[m][n], the tiles of the product of in and w.
template <class S, int kTiles>
__device__ void product(const Rows<S>& in, const Weights<S, kTiles>& w, int lane, S (&c)[2][kTiles][4]) {
  BT_UNROLL
  for (int i = 0; i < 8 * kTiles; ++i) c[i / (4 * kTiles)][i / 4 % kTiles][i % 4] = S(0);
  BT_UNROLL
  for (int j = 0; j < 2; ++j) {
    Factor<S, 4> a[2];
    BT_UNROLL
    for (int m = 0; m < 2; ++m) {
      const S(&v)[4] = in.v[m][j];
      const S first[4] = {v[0], v[2], v[1], v[3]};
      a[m] = factor(first);
    }
    BT_UNROLL
    for (int n = 0; n < kTiles; ++n) {
      const Factor<S, 2> b = w.tile[j][n][lane];
      multiply_add(c[0][n], a[0], b, lane);
      multiply_add(c[1][n], a[1], b, lane);
    }
  }
}
template <class S> __device__ Rows<S> layer(const Rows<S>& in, const Weights<S, 2>& w, int lane) {
  Rows<S> out;
  product(in, w, lane, out.v);
  return out;
}

// A lane's share of the weights' gradients: of w1 and w2 its numbers in product layout, of w3 its look-ups' share of
// four rows.
template <class S> struct WeightSums {
  S w1[2][4], w2[2][4], w3[4][3];
  __device__ WeightSums() {
    BT_UNROLL
    for (int i = 0; i < 8; ++i) w1[i / 4][i % 4] = w2[i / 4][i % 4] = S(0);
    BT_UNROLL
    for (int i = 0; i < 12; ++i) w3[i / 3][i % 3] = S(0);
  }

  // Adds in^T out of 32 look-ups, both [32, 16] in memory, rows `stride` numbers apart. Tensor cores truncate sums, so
  // each sum of 32 starts at 0 and is added here.
  __device__ static void add_outer(S (&sums)[2][4], const S* in, const S* out, int stride, int lane) {
    const int g = lane / 4, t = lane % 4;
    S c[2][4] = {};
    BT_UNROLL
    for (int k = 0; k < kWarp; k += 8) {
      const int first = (k + t) * stride + g, second = first + 4 * stride;
      const S from[4] = {in[first], in[first + 8], in[second], in[second + 8]};
      const Factor<S, 4> a = factor(from);
      BT_UNROLL
      for (int n = 0; n < 2; ++n) {
        const S to[2] = {out[first + 8 * n], out[second + 8 * n]};
        multiply_add(c[n], a, factor(to), lane);
      }
    }
    BT_UNROLL
    for (int i = 0; i < 8; ++i) sums[i / 4][i % 4] += c[i / 4][i % 4];
  }
  // Adds h2^T d, for look-ups g, g + 8, g + 16, g + 24.
  __device__ void add_last(const Rows<S>& h2, const Vec3<S> (&d)[4]) {
    BT_UNROLL
    for (int i = 0; i < 16; ++i) {
      const Vec3<S> o = d[i / 8 * 2 + i / 2 % 2];
      const S h = h2.v[i / 8][i / 4 % 2][i % 4];
      S(&to)[3] = w3[i / 4 % 2 * 2 + i % 2];
      to[0] += h * o.x, to[1] += h * o.y, to[2] += h * o.z;
    }
  }
  // Adds the share to a block's sums [kMlpWeights] in shared memory.
  __device__ void add_to(S* to, int lane) {
    constexpr int kMatrix = kWidth * kWidth;
    const int g = lane / 4, t = lane % 4;
    BT_UNROLL
    for (int i = 0; i < 8; ++i) {
      const int at = (g + i / 2 % 2 * 8) * kWidth + i / 4 * 8 + 2 * t + i % 2;
      to[at] += w1[i / 4][i % 4];
      to[kMatrix + at] += w2[i / 4][i % 4];
    }
    BT_UNROLL
    for (int i = 0; i < 12; ++i) {
      S sum = w3[i / 3][i % 3];
      for (int other = 4; other < kWarp; other *= 2) sum += __shfl_xor_sync(kFullMask, sum, other);
      if (g == 0) to[2 * kMatrix + (i / 6 * 8 + 2 * t + i / 3 % 2) * 3 + i % 3] += sum;
    }
  }
};

}  // namespace bt::cuda
