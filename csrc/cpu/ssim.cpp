// Structural similarity over the valid 11 x 11 Gaussian windows, with its gradient, separable.
#include "core/ssim.h"

#include "cpu/kernels.h"
#include "cpu/threads.h"

namespace bt {

namespace {
constexpr int kTaps = kSsimTaps;

// The five moments of a pair of rows, filtered along the row.
template <class S>
void filter_row(const S* a, const S* b, int n, int stride, const S* k, S* const* out) {
  for (int x = 0; x < n; ++x) {
    S m[5] = {};
    for (int t = 0; t < kTaps; ++t) {
      add_moments(k[t], a[x + t * stride], b[x + t * stride], m);
    }
    for (int j = 0; j < 5; ++j) out[j][x] = m[j];
  }
}

template <class S>
S mean_ssim(const Ssim<S>& images) {
  const int height = images.height, width = images.width, channels = images.channels;
  const S *a = images.a, *b = images.b;
  S* da = images.da;
  static const SsimWindow<S> window;
  const S* k = window.k;
  const int rows = height - kTaps + 1, line = width * channels;
  const int n = (width - kTaps + 1) * channels;  // filtered length of a row
  if (da) std::fill(da, da + int64_t(height) * line, S(0));
  if (rows < 1 || n < 1) return S(1);
  const int64_t plane = int64_t(height) * n;
  std::vector<S> moments(5 * plane), gradient(da ? 3 * int64_t(rows) * n : 0);
  parallel_parts(height, 16, [&](int, int64_t begin, int64_t end) {
    for (int64_t y = begin; y < end; ++y) {
      S* out[5];
      for (int j = 0; j < 5; ++j) out[j] = moments.data() + j * plane + y * n;
      filter_row(a + y * line, b + y * line, n, channels, k, out);
    }
  });
  const S share = S(1) / (S(rows) * S(n));
  std::vector<double> row_sum(rows);
  parallel_parts(rows, 16, [&](int, int64_t begin, int64_t end) {
    std::vector<S> m(5 * n), s(n);
    for (int64_t y = begin; y < end; ++y) {
      std::fill(m.begin(), m.end(), S(0));
      for (int j = 0; j < 5; ++j)
        for (int t = 0; t < kTaps; ++t) {
          const S* from = moments.data() + j * plane + (y + t) * n;
          S* to = m.data() + j * n;
          for (int x = 0; x < n; ++x) to[x] += k[t] * from[x];
        }
      const S *ma = m.data(), *mb = ma + n, *aa = mb + n, *bb = aa + n, *ab = bb + n;
      S* g = da ? gradient.data() + 3 * y * n : nullptr;
      for (int x = 0; x < n; ++x) {
        S d[3];
        s[x] = ssim_window(ma[x], mb[x], aa[x], bb[x], ab[x], d);
        if (g)
          for (int j = 0; j < 3; ++j) g[j * n + x] = share * d[j];
      }
      double total = 0;
      for (int x = 0; x < n; ++x) total += s[x];
      row_sum[y] = total;
    }
  });
  double total = 0;
  for (double r : row_sum) total += r;
  if (da) {
    // transpose of the filter: first down the columns, then along the row
    parallel_parts(height, 16, [&](int, int64_t begin, int64_t end) {
      std::vector<S> down(3 * n), wide(3 * (n + 2 * (kTaps - 1) * channels));
      const int pad = (kTaps - 1) * channels, padded = n + 2 * pad;
      for (int64_t y = begin; y < end; ++y) {
        std::fill(down.begin(), down.end(), S(0));
        for (int t = 0; t < kTaps; ++t) {
          if (y - t < 0 || y - t >= rows) continue;
          const S* from = gradient.data() + 3 * (y - t) * n;
          for (int x = 0; x < 3 * n; ++x) down[x] += k[t] * from[x];
        }
        for (int j = 0; j < 3; ++j) std::copy_n(down.data() + j * n, n, wide.data() + j * padded + pad);
        const S *p = a + y * line, *q = b + y * line, *w0 = wide.data(), *w1 = w0 + padded, *w2 = w1 + padded;
        for (int x = 0; x < line; ++x) {
          S m0 = S(0), m1 = S(0), m2 = S(0);
          for (int t = 0; t < kTaps; ++t) {
            const int at = x + pad - t * channels;
            m0 += k[t] * w0[at], m1 += k[t] * w1[at], m2 += k[t] * w2[at];
          }
          da[y * line + x] = ssim_pixel_gradient(p[x], q[x], m0, m1, m2);
        }
      }
    });
  }
  return S(total * double(share));
}

}  // namespace

template <class S>
void ssim(const Ssim<S>& a) {
  *a.value = mean_ssim(a);
}

template void ssim(const Ssim<float>&);
template void ssim(const Ssim<double>&);

}  // namespace bt
