// SSIM and its gradient, separable, one channel at a time. A block takes a tile of windows: its pixels are loaded into
// shared memory once, filtered along rows, then along columns, each thread keeping its part of a column in registers.
// At 88 bytes and about 400 operations per value for both passes, memory and arithmetic are about balanced on an H200;
// pixels read twice, at tile rims, come from L2.
#include "core/training.h"
#include "cuda/kernels.h"
#include "cuda/warp.h"

namespace bt::cuda {

namespace {
constexpr int kTaps = kSsimTaps, kRim = kTaps - 1;
constexpr int kWide = 32, kRows = 4;  // a tile is 32 columns; a thread takes 4 rows of one
template <class S> constexpr int kThreads = sizeof(S) == 4 ? 128 : 64;  // as 48 KB of shared memory allow
template <class S> constexpr int kHigh = kThreads<S> / kWide * kRows;

// Filters N numbers along the columns, for the rows from y on; the window is symmetric.
template <int N, class S>
__device__ __forceinline__ void filter_columns(const SsimWindow<S>& window, const S (&row)[N][kHigh<S> + kRim][kWide],
                                               int x, int y, S (&m)[N][kRows]) {
  BT_UNROLL
  for (int j = 0; j < N; ++j) {
    BT_UNROLL
    for (int t = 0; t < kTaps + kRows - 1; ++t) {
      const S value = row[j][y + t][x];
      BT_UNROLL
      for (int i = 0; i < kRows; ++i)
        if (t >= i && t - i < kTaps) m[j][i] += window.k[t - i] * value;
    }
  }
}

template <class S> struct Moments {
  S image[2][kHigh<S> + kRim][kWide + kRim];
  S row[5][kHigh<S> + kRim][kWide];
};

template <class S>
__global__ void __launch_bounds__(kThreads<S>)
    windows_kernel(int height, int width, int channels, SsimWindow<S> window, const S* __restrict__ a,
                   const S* __restrict__ b, double* sums, S* __restrict__ parts) {
  __shared__ Moments<S> s;
  __shared__ double total[kThreads<S>];
  const int x0 = int(blockIdx.x) * kWide, y0 = int(blockIdx.y) * kHigh<S>, channel = int(blockIdx.z);
  const int columns = width - kRim, rows = height - kRim, thread = int(threadIdx.x);
  for (int k = thread; k < (kHigh<S> + kRim) * (kWide + kRim); k += kThreads<S>) {
    const int x = k % (kWide + kRim), y = k / (kWide + kRim);
    const bool in = x0 + x < width && y0 + y < height;
    const int64_t at = (int64_t(y0 + y) * width + x0 + x) * channels + channel;
    s.image[0][y][x] = in ? a[at] : S(0);
    s.image[1][y][x] = in ? b[at] : S(0);
  }
  __syncthreads();
  for (int k = thread; k < (kHigh<S> + kRim) * kWide; k += kThreads<S>) {
    const int x = k % kWide, y = k / kWide;
    S m[5] = {};
    BT_UNROLL
    for (int t = 0; t < kTaps; ++t) {
      add_moments(window.k[t], s.image[0][y][x + t], s.image[1][y][x + t], m);
    }
    BT_UNROLL
    for (int j = 0; j < 5; ++j) s.row[j][y][x] = m[j];
  }
  __syncthreads();
  const int x = thread % kWide, y = thread / kWide * kRows;
  S m[5][kRows] = {};
  filter_columns(window, s.row, x, y, m);
  const S share = S(1) / (S(rows) * S(columns) * S(channels));
  double own = 0;
  BT_UNROLL
  for (int i = 0; i < kRows; ++i) {
    if (x0 + x >= columns || y0 + y + i >= rows) continue;
    S d[3];
    own += double(ssim_window(m[0][i], m[1][i], m[2][i], m[3][i], m[4][i], d));
    if (!parts) continue;
    for (int j = 0; j < 3; ++j)
      parts[((int64_t(channel) * 3 + j) * rows + y0 + y + i) * columns + x0 + x] = share * d[j];
  }
  const double sum = block_sum<kThreads<S>>(own, total);
  if (thread == 0) sums[(int64_t(channel) * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x] = sum;
}

// Adds up the blocks in a fixed order.
constexpr int kSumThreads = 256;
template <class S>
__global__ void __launch_bounds__(kSumThreads) mean_kernel(int64_t n, const double* sums, double count, S* value) {
  __shared__ double total[kSumThreads];
  double own = 0;
  for (int64_t i = threadIdx.x; i < n; i += kSumThreads) own += sums[i];
  const double sum = block_sum<kSumThreads>(own, total);
  if (threadIdx.x == 0) *value = count > 0 ? S(sum / count) : S(1);
}

template <class S> struct Parts {
  S window[3][kHigh<S> + kRim][kWide + kRim];
  S row[3][kHigh<S> + kRim][kWide];
};

// Applies the transposed filter: a pixel receives from the windows up to 10 pixels above and left of it.
template <class S>
__global__ void __launch_bounds__(kThreads<S>)
    gradient_kernel(int height, int width, int channels, SsimWindow<S> window, const S* __restrict__ a,
                    const S* __restrict__ b, const S* __restrict__ parts, S* __restrict__ da) {
  __shared__ Parts<S> s;
  const int x0 = int(blockIdx.x) * kWide, y0 = int(blockIdx.y) * kHigh<S>, channel = int(blockIdx.z);
  const int columns = width - kRim, rows = height - kRim, thread = int(threadIdx.x);
  for (int k = thread; k < (kHigh<S> + kRim) * (kWide + kRim); k += kThreads<S>) {
    const int i = k % (kWide + kRim), j = k / (kWide + kRim);
    const int x = x0 + i - kRim, y = y0 + j - kRim;
    const bool in = x >= 0 && y >= 0 && x < columns && y < rows;
    BT_UNROLL
    for (int part = 0; part < 3; ++part)
      s.window[part][j][i] = in ? parts[((int64_t(channel) * 3 + part) * rows + y) * columns + x] : S(0);
  }
  __syncthreads();
  for (int k = thread; k < (kHigh<S> + kRim) * kWide; k += kThreads<S>) {
    const int x = k % kWide, y = k / kWide;
    BT_UNROLL
    for (int part = 0; part < 3; ++part) {
      S m = S(0);
      BT_UNROLL
      for (int t = 0; t < kTaps; ++t) m += window.k[t] * s.window[part][y][x + kRim - t];
      s.row[part][y][x] = m;
    }
  }
  __syncthreads();
  const int x = thread % kWide, y = thread / kWide * kRows;
  S m[3][kRows] = {};
  filter_columns(window, s.row, x, y, m);
  BT_UNROLL
  for (int i = 0; i < kRows; ++i) {
    if (x0 + x >= width || y0 + y + i >= height) continue;
    const int64_t at = (int64_t(y0 + y + i) * width + x0 + x) * channels + channel;
    da[at] = ssim_pixel_gradient(a[at], b[at], m[0][i], m[1][i], m[2][i]);
  }
}

// Tiles and working memory of a call.
template <class S> struct Plan {
  int64_t rows, columns;  // of windows
  dim3 windows, pixels;   // blocks
  double* sums;           // [blocks of windows]
  S* parts;               // [channels, 3, rows, columns], with a gradient

  Plan(Arena& arena, int height, int width, int channels, bool gradient)
      : rows(height - kRim), columns(width - kRim), windows(0, 0, 0) {
    const auto blocks = [channels](int64_t wide, int64_t high) {
      return dim3(unsigned(ceil_div(wide, kWide)), unsigned(ceil_div(high, kHigh<S>)), unsigned(channels));
    };
    if (rows > 0 && columns > 0) windows = blocks(columns, rows);
    pixels = blocks(width, height);
    sums = arena.take<double>(count());
    parts = arena.take<S>(gradient && count() ? 3 * rows * columns * channels : 0);
  }
  int64_t count() const { return int64_t(windows.x) * windows.y * windows.z; }
};
}  // namespace

template <class S> int64_t ssim_workspace(int height, int width, int channels, bool gradient) {
  return space_bytes<Plan<S>>(height, width, channels, gradient);
}

template <class S> void ssim(const Ssim<S>& images, Stream stream) {
  const int height = images.height, width = images.width, channels = images.channels;
  const S *a = images.a, *b = images.b;
  S* da = images.da;
  const Plan<S> plan = cut_space<Plan<S>>(images.workspace, height, width, channels, da != nullptr);
  const SsimWindow<S> window;
  const bool any = plan.count() > 0;
  if (any)
    BT_LAUNCH(windows_kernel<S>, plan.windows, dim3(kThreads<S>), 0, stream, height, width, channels, window, a, b,
              plan.sums, da ? plan.parts : nullptr);
  BT_LAUNCH(mean_kernel<S>, dim3(1), dim3(kSumThreads), 0, stream, plan.count(), plan.sums,
            any ? double(plan.rows) * double(plan.columns) * channels : 0.0, images.value);
  if (da && any)
    BT_LAUNCH(gradient_kernel<S>, plan.pixels, dim3(kThreads<S>), 0, stream, height, width, channels, window, a, b,
              plan.parts, da);
  else if (da)
    fill_zero(da, int64_t(height) * width * channels, stream);
}

template int64_t ssim_workspace<float>(int, int, int, bool);
template int64_t ssim_workspace<double>(int, int, int, bool);
BT_INSTANTIATE(ssim, Ssim)

}  // namespace bt::cuda
