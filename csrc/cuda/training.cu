// Losses and densification statistics of a training step; see training.h.
#include <cmath>

#include "core/common.h"
#include "cuda/training.h"
#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int kThreads = 256;

template <class S> BT_HD S sign_(S x) {
  return x > S(0) ? S(1) : x < S(0) ? S(-1) : x;  // keeps 0 and NaN
}

template <class S> struct Error {
  S d[3], l1, omega;
};
template <class S> BT_HD Error<S> error_at(const Picture<S>& p, int64_t i) {
  Error<S> e;
  e.l1 = S(0);
  for (int k = 0; k < 3; ++k) {
    e.d[k] = p.image[i * kImageChannels + k] - p.target[3 * i + k];
    e.l1 += e.d[k] < S(0) ? -e.d[k] : e.d[k];
  }
  e.omega = S(exp(-p.gamma * e.l1));
  return e;
}

// Sums over the block, to thread 0.
__device__ void add_up(double (&own)[kLossSums], double (*total)[kThreads]) {
  for (int k = 0; k < kLossSums; ++k) own[k] = block_sum<kThreads>(own[k], total[k]);
}

template <class S> BT_HD bool counts(const Picture<S>& p, int64_t i) { return !p.mask || p.mask[i]; }

template <class S> __global__ void __launch_bounds__(kThreads) sums_kernel(Picture<S> p, double* sums) {
  __shared__ double total[kLossSums][kThreads];
  double own[kLossSums] = {};
  const int64_t step = int64_t(gridDim.x) * kThreads;
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < p.pixels; i += step) {
    if (!counts(p, i)) continue;
    const Error<S> e = error_at(p, i);
    own[0] += double(e.l1), own[1] += double(e.omega * p.image[i * kImageChannels + 4]), own[2] += 1;
  }
  add_up(own, total);
  if (threadIdx.x) return;
  for (int k = 0; k < kLossSums; ++k) sums[kLossSums * blockIdx.x + k] = own[k];
}

template <class S>
__global__ void __launch_bounds__(kThreads)
    loss_kernel(int blocks, const double* __restrict__ sums, S share, S weight, const S* __restrict__ similarity,
                S* photometric, S* falloff, S* counted) {
  __shared__ double total[kLossSums][kThreads];
  double own[kLossSums] = {};
  for (int i = int(threadIdx.x); i < blocks; i += kThreads)
    for (int k = 0; k < kLossSums; ++k) own[k] += sums[kLossSums * i + k];
  add_up(own, total);
  if (threadIdx.x) return;
  const double count = own[2] > 1 ? own[2] : 1;
  const S l1 = S(own[0] / (3.0 * count)), right = S(own[1] / count);
  *counted = S(count);
  *photometric = (S(1) - share) * l1 + share * (S(1) - *similarity);
  *falloff = weight * right;
}

template <class S>
__global__ void __launch_bounds__(kThreads)
    gradient_kernel(Picture<S> p, S share, S weight, const S* __restrict__ dsimilarity,
                    const S* __restrict__ dphotometric, const S* __restrict__ dfalloff, const S* __restrict__ counted,
                    S* __restrict__ dimage) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= p.pixels) return;
  S* to = dimage + i * kImageChannels;
  if (!counts(p, i)) {
    for (int k = 0; k < kImageChannels; ++k) to[k] = S(0);
    return;
  }
  const Error<S> e = error_at(p, i);
  const S l1 = *dphotometric * (S(1) - share) / (S(3) * *counted), similar = *dphotometric * share;
  for (int k = 0; k < 3; ++k) to[k] = l1 * sign_(e.d[k]) - similar * dsimilarity[3 * i + k];
  to[3] = S(0);
  to[4] = *dfalloff * weight / *counted * e.omega;
}

template <class S> BT_HD float length_(S x, S y) {
  const S size = hypot(x, y);
  return finite_(size) ? float(size) : 0.0f;
}

template <class S> __global__ void __launch_bounds__(kThreads) note_kernel(NoteCenters<S> a) {
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

dim3 blocks_for(int64_t n) { return dim3(unsigned(ceil_div(n, kThreads))); }
}  // namespace

template <class S> void picture_loss(const PictureLoss<S>& a, Stream stream) {
  const int64_t wanted = ceil_div(a.picture.pixels, kThreads);
  const int blocks = int(wanted < kMostSums ? wanted : kMostSums);
  if (blocks) BT_LAUNCH(sums_kernel<S>, dim3(unsigned(blocks)), dim3(kThreads), 0, stream, a.picture, a.sums);
  BT_LAUNCH(loss_kernel<S>, dim3(1), dim3(kThreads), 0, stream, blocks, a.sums, a.share, a.weight, a.similarity,
            a.photometric, a.falloff, a.counted);
}

template <class S> void picture_loss_backward(const PictureLossBackward<S>& a, Stream stream) {
  if (!a.picture.pixels) return;
  BT_LAUNCH(gradient_kernel<S>, blocks_for(a.picture.pixels), dim3(kThreads), 0, stream, a.picture, a.share, a.weight,
            a.dsimilarity, a.dphotometric, a.dfalloff, a.counted, a.dimage);
}

template <class S> void note_centers(const NoteCenters<S>& a, Stream stream) {
  if (a.n) BT_LAUNCH(note_kernel<S>, blocks_for(a.n), dim3(kThreads), 0, stream, a);
}

#define BT_INSTANTIATE(S)                                                     \
  template void picture_loss(const PictureLoss<S>&, Stream);                  \
  template void picture_loss_backward(const PictureLossBackward<S>&, Stream); \
  template void note_centers(const NoteCenters<S>&, Stream);
BT_INSTANTIATE(float)
BT_INSTANTIATE(double)

}  // namespace bt::cuda
