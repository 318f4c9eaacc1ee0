// Structural similarity over the valid 11 x 11 Gaussian windows, separable, with its gradient.
#include "core/training.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace bt {

namespace {
constexpr int kTaps = kSsimTaps;
constexpr int kMoments = 5, kSlopes = 3;  // means of a window, derivatives with respect to three of them

inline int whole_vectors(int n) { return (n + kLanes - 1) / kLanes * kLanes; }

// Ring buffer of the last kTaps rows, each with several columns; unwritten rows are 0.
template <class S> class LastRows {
 public:
  LastRows(int columns, int length)
      : columns_(columns), length_(length), numbers_(size_t(kTaps) * columns * length, S(0)) {}
  S* row(int64_t y, int column) {
    return numbers_.data() + (size_t((y % kTaps + kTaps) % kTaps) * columns_ + column) * length_;
  }
  void clear(int64_t y) { std::fill_n(row(y, 0), columns_ * length_, S(0)); }

 private:
  int columns_, length_;
  std::vector<S> numbers_;
};

// Working memory of a thread.
template <class S> class Band {
  using P = Lanes<S>;

 public:
  explicit Band(const Ssim<S>& images)
      : a_(images.a),
        b_(images.b),
        da_(images.da),
        channels_(images.channels),
        line_(images.width * images.channels),
        rows_(images.height - kTaps + 1),
        n_((images.width - kTaps + 1) * images.channels),
        length_(whole_vectors(n_)),
        pad_((kTaps - 1) * images.channels),
        share_(S(1) / (S(rows_) * S(n_))),
        products_(kMoments * (length_ + pad_), S(0)),
        moments_(kMoments, length_),
        slopes_(kSlopes, length_),
        wide_(kSlopes * (whole_vectors(line_) + pad_), S(0)) {
    const SsimWindow<S> window;
    for (int t = 0; t < kTaps; ++t) k_[t] = P(window.k[t]);
  }

  // row_sum [rows]: sums of the windows' values.
  void run(int64_t from, int64_t to, double* row_sum) {
    // a pixel's gradient needs windows from kTaps - 1 rows above, a window as many rows below
    const int64_t first = da_ ? std::max<int64_t>(0, from - kTaps + 1) : from, last = std::min<int64_t>(to, rows_);
    for (int64_t y = first; y < std::min<int64_t>(first + kTaps - 1, last + kTaps - 1); ++y) filter_row(y);
    for (int64_t y = first; y < to; ++y) {
      if (y < last) {
        filter_row(y + kTaps - 1);
        const double sum = windows(y);
        if (y >= from) row_sum[y] = sum;
      } else {
        slopes_.clear(y);
      }
      if (da_ && y >= from) gradient_row(y);
    }
  }

 private:
  // Filters the five moments of row y along the row.
  void filter_row(int64_t y) {
    const S *a = a_ + y * line_, *b = b_ + y * line_;
    S* p[kMoments];
    for (int j = 0; j < kMoments; ++j) p[j] = products_.data() + j * (length_ + pad_);
    for (int x = 0; x < line_; ++x) {
      const S u = a[x], v = b[x];
      p[0][x] = u, p[1][x] = v, p[2][x] = u * u, p[3][x] = v * v, p[4][x] = u * v;
    }
    for (int j = 0; j < kMoments; ++j) {
      S* out = moments_.row(y, j);
      for (int x = 0; x < length_; x += kLanes) {
        P m = k_[0] * load(p[j] + x);
        for (int t = 1; t < kTaps; ++t) m += k_[t] * load(p[j] + x + t * channels_);
        store(out + x, m);
      }
    }
  }

  // Sums the values of the windows that begin in row y, keeping their slopes.
  double windows(int64_t y) {
    P lane, sum = P(S(0));
    for (int i = 0; i < kLanes; ++i) lane.set(i, S(i));
    for (int x = 0; x < length_; x += kLanes) {
      P m[kMoments], d[kSlopes];
      for (int j = 0; j < kMoments; ++j) {
        m[j] = k_[0] * load(moments_.row(y, j) + x);
        for (int t = 1; t < kTaps; ++t) m[j] += k_[t] * load(moments_.row(y + t, j) + x);
      }
      const auto there = lane < P(S(n_ - x));
      sum += select(there, ssim_window(m[0], m[1], m[2], m[3], m[4], d), P(S(0)));
      if (da_)
        for (int j = 0; j < kSlopes; ++j) store(slopes_.row(y, j) + x, select(there, P(share_) * d[j], P(S(0))));
    }
    double total = 0;
    for (int i = 0; i < kLanes; ++i) total += sum[i];
    return total;
  }

  // Applies the transposed filter: columns first, then the row.
  void gradient_row(int64_t y) {
    const int stride = whole_vectors(line_) + pad_;
    for (int j = 0; j < kSlopes; ++j)
      for (int x = 0; x < length_; x += kLanes) {
        P m = k_[0] * load(slopes_.row(y, j) + x);
        for (int t = 1; t < kTaps; ++t) m += k_[t] * load(slopes_.row(y - t, j) + x);
        store(wide_.data() + j * stride + pad_ + x, m);
      }
    for (int x = 0; x < line_; x += kLanes) {
      P m[kSlopes];
      for (int j = 0; j < kSlopes; ++j) {
        const S* w = wide_.data() + j * stride + pad_ + x;
        m[j] = k_[0] * load(w);
        for (int t = 1; t < kTaps; ++t) m[j] += k_[t] * load(w - t * channels_);
      }
      const int64_t at = y * line_ + x;
      const int count = std::min(kLanes, line_ - x);
      const P gradient = ssim_pixel_gradient(load_some(a_ + at, count), load_some(b_ + at, count), m[0], m[1], m[2]);
      S all[kLanes];
      store(all, gradient);
      std::copy_n(all, count, da_ + at);
    }
  }
  static P load_some(const S* p, int count) {
    if (count == kLanes) return load(p);
    S all[kLanes] = {};
    std::copy_n(p, count, all);
    return load(all);
  }

  const S *a_, *b_;
  S* da_;
  int channels_, line_, rows_, n_, length_, pad_;
  S share_;
  P k_[kTaps];
  std::vector<S> products_;
  LastRows<S> moments_, slopes_;
  std::vector<S> wide_;
};

template <class S> S mean_ssim(const Ssim<S>& images) {
  const int height = images.height, rows = height - kTaps + 1, columns = images.width - kTaps + 1;
  if (images.da) std::fill_n(images.da, int64_t(height) * images.width * images.channels, S(0));
  if (rows < 1 || columns < 1 || images.channels < 1) return S(1);
  std::vector<double> row_sum(rows);
  parallel_parts(height, 4 * kTaps,
                 [&](int, int64_t begin, int64_t end) { Band<S>(images).run(begin, end, row_sum.data()); });
  double total = 0;
  for (double r : row_sum) total += r;
  return S(total / (double(rows) * columns * images.channels));
}

}  // namespace

template <class S> void ssim(const Ssim<S>& a) { *a.value = mean_ssim(a); }

BT_INSTANTIATE(ssim, Ssim)

}  // namespace bt
