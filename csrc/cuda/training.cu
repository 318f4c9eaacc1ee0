// Losses, densification statistics and Adam of a training step; see training.h.
#include <cmath>

#include "core/common.h"
#include "core/training.h"
#include "cuda/kernels.h"
#include "cuda/training.h"
#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 256;
constexpr int kMostSums = 1024, kLossSums = 3;  // most blocks with sums; their sums of l1, right and count

template <class S> BT_HD S sign_(S x) {
  return x > S(0) ? S(1) : x < S(0) ? S(-1) : x;  // keeps 0 and NaN
}

template <class S> BT_HD bool counts(const Picture<S>& p, int64_t i) { return !p.mask || p.mask[i]; }

// Working memory of the forward and the backward pass.
template <class S> struct PictureSpace {
  static constexpr int kCorrected = 12;  // most numbers of a correction
  double *loss_sums, *correction_sums;   // [kMostSums, kLossSums], [kMostSums, kCorrected]
  S *similarity, *counted;               // [1]
  S *shown, *wanted, *dsimilarity;       // [pixels, 3]
  Workspace ssim;
  PictureSpace(Arena& arena, int height, int width) {
    const int64_t pixels = int64_t(height) * width, bytes = ssim_workspace<S>(height, width, 3, true);
    loss_sums = arena.take<double>(kMostSums * kLossSums);
    correction_sums = arena.take<double>(kMostSums * kCorrected);
    similarity = arena.take<S>(1), counted = arena.take<S>(1);
    shown = arena.take<S>(3 * pixels), wanted = arena.take<S>(3 * pixels), dsimilarity = arena.take<S>(3 * pixels);
    ssim = {arena.take<char>(bytes), bytes};
  }
};
template <class S> PictureSpace<S> picture_space(const Picture<S>& p) {
  return cut_space<PictureSpace<S>>(p.workspace, p.height, p.width);
}

// Applies the correction and adds the background; masked-out pixels are made equal in both pictures.
template <class S> __global__ void __launch_bounds__(kThreads) show_kernel(Picture<S> p, PictureSpace<S> to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= p.pixels()) return;
  const S *from = p.image + i * kImageChannels, alpha = from[3];
  const bool counting = counts(p, i);
  for (int k = 0; k < 3; ++k) {
    S value = from[k];
    if (p.corrected == 3) value *= p.correction[k];
    if (p.corrected == 12) {
      const S* row = p.correction + 4 * k;
      value = from[0] * row[0] + from[1] * row[1] + from[2] * row[2] + alpha * row[3];
    }
    if (p.background) value += (S(1) - alpha) * p.background[k];
    to.shown[3 * i + k] = counting ? value : S(0);
    to.wanted[3 * i + k] = counting ? p.target[3 * i + k] : S(0);
  }
}

template <class S> struct Error {
  S d[3], l1, omega;
};
template <class S> BT_HD Error<S> error_at(const PictureSpace<S>& of, S gamma, int64_t i) {
  Error<S> e;
  e.l1 = S(0);
  for (int k = 0; k < 3; ++k) {
    e.d[k] = of.shown[3 * i + k] - of.wanted[3 * i + k];
    e.l1 += e.d[k] < S(0) ? -e.d[k] : e.d[k];
  }
  e.omega = S(exp(-gamma * e.l1));
  return e;
}

// Sums over the block, to thread 0.
template <int kSums> __device__ void add_up(double (&own)[kSums], double (*total)[kThreads]) {
  BT_UNROLL
  for (int k = 0; k < kSums; ++k) own[k] = block_sum<kThreads>(own[k], total[k]);
}

template <class S> __global__ void __launch_bounds__(kThreads) sums_kernel(Picture<S> p, PictureSpace<S> of) {
  __shared__ double total[kLossSums][kThreads];
  double own[kLossSums] = {};
  const int64_t step = int64_t(gridDim.x) * kThreads;
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < p.pixels(); i += step) {
    if (!counts(p, i)) continue;
    const Error<S> e = error_at(of, p.falloff_gamma, i);
    own[0] += double(e.l1), own[1] += double(e.omega * p.image[i * kImageChannels + 4]), own[2] += 1;
  }
  add_up(own, total);
  if (threadIdx.x) return;
  for (int k = 0; k < kLossSums; ++k) of.loss_sums[kLossSums * blockIdx.x + k] = own[k];
}

template <class S>
__global__ void __launch_bounds__(kThreads)
    loss_kernel(int blocks, Picture<S> p, PictureSpace<S> of, S* photometric, S* falloff) {
  __shared__ double total[kLossSums][kThreads];
  double own[kLossSums] = {};
  for (int i = int(threadIdx.x); i < blocks; i += kThreads)
    for (int k = 0; k < kLossSums; ++k) own[k] += of.loss_sums[kLossSums * i + k];
  add_up(own, total);
  if (threadIdx.x) return;
  const double count = own[2] > 1 ? own[2] : 1;
  const S l1 = S(own[0] / (3.0 * count)), right = S(own[1] / count);
  *of.counted = S(count);
  *photometric = (S(1) - p.ssim_weight) * l1 + p.ssim_weight * (S(1) - *of.similarity);
  *falloff = p.falloff_weight * right;
}

template <class S, bool kCorrected>
__global__ void __launch_bounds__(kThreads)
    gradient_kernel(Picture<S> p, PictureSpace<S> of, const S* __restrict__ dphotometric,
                    const S* __restrict__ dfalloff, S* __restrict__ dimage) {
  constexpr int kSums = kCorrected ? PictureSpace<S>::kCorrected : 1;
  double own[kSums] = {};
  const S l1 = *dphotometric * (S(1) - p.ssim_weight) / (S(3) * *of.counted), similar = *dphotometric * p.ssim_weight;
  const S right = *dfalloff * p.falloff_weight / *of.counted;
  const int64_t step = int64_t(gridDim.x) * kThreads;
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < p.pixels(); i += step) {
    S* to = dimage + i * kImageChannels;
    if (!counts(p, i)) {
      for (int k = 0; k < kImageChannels; ++k) to[k] = S(0);
      continue;
    }
    const Error<S> e = error_at(of, p.falloff_gamma, i);
    const S* from = p.image + i * kImageChannels;
    S d[3], dalpha = S(0);
    BT_UNROLL
    for (int k = 0; k < 3; ++k) {
      d[k] = l1 * sign_(e.d[k]) - similar * of.dsimilarity[3 * i + k];
      if (p.background) dalpha -= d[k] * p.background[k];
    }
    BT_UNROLL
    for (int k = 0; k < 3; ++k) {
      S dk = d[k];
      if constexpr (kCorrected) {
        if (p.corrected == 3) {
          own[k] += double(dk * from[k]), dk *= p.correction[k];
        } else {
          BT_UNROLL
          for (int j = 0; j < 4; ++j) own[4 * k + j] += double(d[k] * from[j]);
          dalpha += d[k] * p.correction[4 * k + 3];
          dk = d[0] * p.correction[k] + d[1] * p.correction[4 + k] + d[2] * p.correction[8 + k];
        }
      }
      to[k] = dk;
    }
    to[3] = dalpha;
    to[4] = right * e.omega;
  }
  if constexpr (kCorrected) {
    __shared__ double total[kSums][kThreads];
    add_up(own, total);
    if (threadIdx.x == 0)
      for (int k = 0; k < kSums; ++k) of.correction_sums[kSums * blockIdx.x + k] = own[k];
  }
}
template <class S>
__global__ void __launch_bounds__(kThreads) correction_kernel(int blocks, int corrected, const double* sums, S* to) {
  constexpr int kSums = PictureSpace<S>::kCorrected;
  __shared__ double total[kSums][kThreads];
  double own[kSums] = {};
  for (int i = int(threadIdx.x); i < blocks; i += kThreads)
    for (int k = 0; k < kSums; ++k) own[k] += sums[kSums * i + k];
  add_up(own, total);
  if (threadIdx.x == 0)
    for (int k = 0; k < corrected; ++k) to[k] = S(own[k]);
}

template <class S> BT_HD float length_(S x, S y) {
  const S size = hypot(x, y);
  return finite_(size) ? float(size) : 0.0f;
}

template <class S> __global__ void __launch_bounds__(kThreads) statistics_kernel(DensifyStatistics<S> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= a.n || !(a.radii[2 * i] > S(0))) return;
  const S x = S(0.5) * S(a.width), y = S(0.5) * S(a.height);
  if (a.grad) a.grad_sum[i] += length_(x * a.grad[2 * i], y * a.grad[2 * i + 1]);
  if (a.absgrad) a.abs_grad_sum[i] += length_(x * a.absgrad[2 * i], y * a.absgrad[2 * i + 1]);
  a.visible_count[i] += 1.0f;
  const S wide = a.radii[2 * i], high = a.radii[2 * i + 1];
  const float radius = float(wide > high ? wide : high);
  if (radius > a.max_radius[i]) a.max_radius[i] = radius;
}

int sum_blocks(int64_t n) { return int(min_(ceil_div(n, kThreads), int64_t(kMostSums))); }

// Parameters of one launch; each has the blocks from first_block on.
constexpr int kAdamEach = 4;  // numbers per thread
template <class S> struct AdamParameters {
  AdamParameter<S> each[kAdamParameters];
  unsigned first_block[kAdamParameters];
  int count;
};
template <class S> __global__ void __launch_bounds__(kThreads) count_kernel(AdamParameters<S> a) {
  if (int(threadIdx.x) < a.count) *a.each[threadIdx.x].step += 1.0f;
}
template <class S> __global__ void __launch_bounds__(kThreads) adam_kernel(AdamParameters<S> a) {
  int of = a.count - 1;
  while (blockIdx.x < a.first_block[of]) --of;
  const AdamParameter<S>& r = a.each[of];
  const AdamRates<S> rates = adam_rates<S>(r.rate, r.beta1, r.beta2, r.eps, double(*r.step));
  const int64_t first = int64_t(blockIdx.x - a.first_block[of]) * (kThreads * kAdamEach) + threadIdx.x;
  BT_UNROLL
  for (int k = 0; k < kAdamEach; ++k) {
    const int64_t i = first + k * kThreads;
    if (i >= r.count) return;
    const S moved = adam_step(rates, r.gradient[i], r.mean[i], r.square[i]);
    r.parameter[i] += r.factors ? r.factors[i / r.width] * moved : moved;
  }
}

// One block: the Adam step of the row, then, with settle, the projection of the table's columns one after another.
template <class S> __global__ void __launch_bounds__(kThreads) exposure_kernel(LearnExposure<S> a) {
  __shared__ double shared[kThreads];
  const int thread = int(threadIdx.x);
  if (thread < a.width) a.move(thread);
  for (int column = 0; a.settle && column < a.width; ++column) {
    __syncthreads();
    const S limit = a.limit_of(column);
    double sum = 0;
    for (int64_t i = thread; i < a.photographs; i += kThreads)
      sum += double(limited_entry(a.table[i * a.width + column], limit));
    block_sum<kThreads>(sum, shared);
    __syncthreads();
    const S mean = S(shared[0] / double(a.photographs));
    S largest = S(0);
    for (int64_t i = thread; i < a.photographs; i += kThreads)
      largest = max_(largest, abs_(limited_entry(a.table[i * a.width + column], limit) - mean));
    __syncthreads();
    shared[thread] = double(largest);
    for (int half = kThreads / 2; half; half /= 2) {
      __syncthreads();
      if (thread < half) shared[thread] = max_(shared[thread], shared[thread + half]);
    }
    __syncthreads();
    const S over = max_(S(shared[0]) / limit, S(1));
    for (int64_t i = thread; i < a.photographs; i += kThreads) {
      S& entry = a.table[i * a.width + column];
      entry = (limited_entry(entry, limit) - mean) / over;
    }
  }
}
}  // namespace

template <class S> int64_t picture_workspace(int height, int width) {
  return space_bytes<PictureSpace<S>>(height, width);
}

template <class S> void picture_loss(const Picture<S>& p, S* photometric, S* falloff, Stream stream) {
  const PictureSpace<S> space = picture_space(p);
  BT_LAUNCH_EACH(show_kernel<S>, p.pixels(), kThreads, stream, p, space);
  ssim(Ssim<S>{p.height, p.width, 3, space.shown, space.wanted, space.similarity, space.dsimilarity, space.ssim},
       stream);
  const int blocks = sum_blocks(p.pixels());
  if (blocks) BT_LAUNCH(sums_kernel<S>, dim3(unsigned(blocks)), dim3(kThreads), 0, stream, p, space);
  BT_LAUNCH(loss_kernel<S>, dim3(1), dim3(kThreads), 0, stream, blocks, p, space, photometric, falloff);
}

template <class S>
void picture_loss_backward(const Picture<S>& p, const S* dphotometric, const S* dfalloff, S* dimage, S* dcorrection,
                           Stream stream) {
  const PictureSpace<S> space = picture_space(p);
  const int blocks = sum_blocks(p.pixels());
  const auto run = p.corrected ? gradient_kernel<S, true> : gradient_kernel<S, false>;
  if (blocks)
    BT_LAUNCH(run, dim3(unsigned(blocks)), dim3(kThreads), 0, stream, p, space, dphotometric, dfalloff, dimage);
  if (dcorrection)
    BT_LAUNCH(correction_kernel<S>, dim3(1), dim3(kThreads), 0, stream, blocks, p.corrected, space.correction_sums,
              dcorrection);
}

template <class S> void accumulate_statistics(const DensifyStatistics<S>& a, Stream stream) {
  BT_LAUNCH_EACH(statistics_kernel<S>, a.n, kThreads, stream, a);
}

template <class S> void adam(const AdamParameter<S>* parameters, int count, Stream stream) {
  for (int from = 0; from < count; from += kAdamParameters) {
    AdamParameters<S> a = {};
    a.count = min_(count - from, kAdamParameters);
    unsigned blocks = 0;
    for (int i = 0; i < a.count; ++i) {
      a.each[i] = parameters[from + i], a.first_block[i] = blocks;
      blocks += unsigned(ceil_div(a.each[i].count, kThreads * kAdamEach));
    }
    BT_LAUNCH(count_kernel<S>, dim3(1), dim3(kThreads), 0, stream, a);
    if (blocks) BT_LAUNCH(adam_kernel<S>, dim3(blocks), dim3(kThreads), 0, stream, a);
  }
}

template <class S> void learn_exposure(const LearnExposure<S>& a, Stream stream) {
  BT_LAUNCH(exposure_kernel<S>, dim3(1), dim3(kThreads), 0, stream, a);
}

template int64_t picture_workspace<float>(int, int);
template int64_t picture_workspace<double>(int, int);
BT_INSTANTIATE(learn_exposure, LearnExposure)
template void adam(const AdamParameter<float>*, int, Stream);
template void adam(const AdamParameter<double>*, int, Stream);
template void picture_loss(const Picture<float>&, float*, float*, Stream);
template void picture_loss(const Picture<double>&, double*, double*, Stream);
template void picture_loss_backward(const Picture<float>&, const float*, const float*, float*, float*, Stream);
template void picture_loss_backward(const Picture<double>&, const double*, const double*, double*, double*, Stream);
BT_INSTANTIATE(accumulate_statistics, DensifyStatistics)

}  // namespace bt::cuda
