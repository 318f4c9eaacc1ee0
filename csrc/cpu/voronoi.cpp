// Fit of Spherical Voronoi colours and ranking of their sites, a lane for every surfel.
#include "cpu/kernels.h"
#include "cpu/simd.h"

namespace bt {

namespace {
constexpr int kSample = 7;
constexpr int kSquare[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};  // entries of a symmetric 3 x 3 matrix
int pair(int i, int j) { return i * (i + 1) / 2 + j; }            // entry of a symmetric matrix, i >= j

// Cholesky factor of a symmetric matrix, in place, its diagonal inverted; NaN where it is not positive definite.
template <class P> void factorize(P* m, int n) {
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      P sum = m[pair(i, j)];
      for (int k = 0; k < j; ++k) sum = sum - m[pair(i, k)] * m[pair(j, k)];
      m[pair(i, j)] = i == j ? P(1.0) / sqrt_(sum) : sum * m[pair(j, j)];
    }
}
// x becomes L^-1 x, or L^-T x.
template <class P> void solve(const P* l, int n, P* x) {
  for (int i = 0; i < n; ++i) {
    for (int k = 0; k < i; ++k) x[i] -= l[pair(i, k)] * x[k];
    x[i] = x[i] * l[pair(i, i)];
  }
}
template <class P> void solve_back(const P* l, int n, P* x) {
  for (int i = n; i-- > 0;) {
    for (int k = i + 1; k < n; ++k) x[i] -= l[pair(k, i)] * x[k];
    x[i] = x[i] * l[pair(i, i)];
  }
}

// Loads `width` numbers of `count` surfels; lanes beyond repeat the last one.
template <class S> void gather(const S* from, int64_t first, int count, int width, Lanes<S>* to) {
  alignas(64) S lanes[kLanes];
  for (int i = 0; i < width; ++i) {
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = from[(first + std::min(lane, count - 1)) * width + i];
    to[i] = load(lanes);
  }
}

template <class S> class SiteLanes {
  using P = Lanes<S>;

 public:
  explicit SiteLanes(const FitSites<S>& a)
      : a_(a),
        sites_(a.sites),
        terms_(sites_ - 1),
        linear_(3 * terms_),
        colors_(3 * sites_),
        samples_(a.directions * kSample),
        vv_(pair(linear_, 0)),
        cc_(pair(sites_, 0)),
        vc_(linear_ * colors_) {}

  // Surfels from `first` on: as many as there are lanes, or fewer at the end.
  void run(int64_t first) {
    const int count = int(std::min<int64_t>(kLanes, a_.n - first));
    gather(a_.samples, first, count, int(samples_.size()), samples_.data());
    gather(a_.vectors, first, count, linear_, now_.v);
    gather(a_.colors, first, count, colors_, now_.c);
    P cost = error_of(now_), damping(S(1e-3));
    for (int round = 0; round < a_.rounds; ++round) {
      assemble();
      step(damping);
      const P found = error_of(next_);
      const auto better = found < cost;  // false where it is not finite
      for (int i = 0; i < linear_; ++i) now_.v[i] = select(better, next_.v[i], now_.v[i]);
      for (int i = 0; i < colors_; ++i) now_.c[i] = select(better, next_.c[i], now_.c[i]);
      cost = select(better, found, cost), damping = select(better, P(S(0.3)), P(S(8))) * damping;
    }
    scatter(now_.v, first, count, linear_, a_.vectors);
    scatter(now_.c, first, count, colors_, a_.colors);
  }

 private:
  struct Fit {
    P v[3 * kMaxTerms], c[3 * kMaxTerms];  // vectors of the sites from the second on; colours of all
  };

  static void scatter(const P* from, int64_t first, int count, int width, S* to) {
    for (int i = 0; i < width; ++i)
      for (int lane = 0; lane < count; ++lane) to[(first + lane) * width + i] = from[i][lane];
  }

  // Weights of the sites at a sample, and how far its colour is from the target.
  void shade(const P* sample, const Fit& fit, P* w, P* error) const {
    P most(S(0)), sum(S(0));
    w[0] = most;
    for (int k = 1; k < sites_; ++k) {
      const P* v = fit.v + 3 * (k - 1);
      w[k] = v[0] * sample[0] + v[1] * sample[1] + v[2] * sample[2], most = max_(most, w[k]);
    }
    for (int k = 0; k < sites_; ++k) w[k] = exp_(w[k] - most), sum += w[k];
    const P share = P(S(1)) / sum;
    for (int c = 0; c < 3; ++c) error[c] = -sample[3 + c];
    for (int k = 0; k < sites_; ++k) {
      w[k] = w[k] * share;
      for (int c = 0; c < 3; ++c) error[c] += w[k] * fit.c[3 * k + c];
    }
  }
  P error_of(const Fit& fit) const {
    P w[kMaxTerms], e[3], sum(S(0));
    for (const P *s = samples_.data(), *end = s + samples_.size(); s < end; s += kSample) {
      shade(s, fit, w, e);
      sum += s[6] * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]);
    }
    return sum;
  }

  // Gauss-Newton matrix and gradient: vv, vc, cc are its blocks of vectors and colours, cc the same for each channel.
  void assemble() {
    for (std::vector<P>* m : {&vv_, &cc_, &vc_}) std::fill(m->begin(), m->end(), P(S(0)));
    std::fill(step_.v, step_.v + linear_, P(S(0))), std::fill(step_.c, step_.c + colors_, P(S(0)));
    P w[kMaxTerms], e[3], a[kMaxTerms][3], square[6];
    for (const P *s = samples_.data(), *end = s + samples_.size(); s < end; s += kSample) {
      shade(s, now_, w, e);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j <= i; ++j) square[kSquare[i][j]] = s[i] * s[j];
      for (int k = 0; k < terms_; ++k) {
        P pull(S(0)), qa[3];
        for (int c = 0; c < 3; ++c) {
          a[k][c] = w[k + 1] * (now_.c[3 * (k + 1) + c] - (e[c] + s[3 + c]));  // d colour / d logit
          qa[c] = s[6] * a[k][c], pull += qa[c] * e[c];
        }
        for (int l = 0; l <= k; ++l) {
          const P both = qa[0] * a[l][0] + qa[1] * a[l][1] + qa[2] * a[l][2];
          for (int i = 0; i < 3; ++i) {
            P* row = vv_.data() + pair(3 * k + i, 3 * l);
            for (int j = 0; j <= (k == l ? i : 2); ++j) row[j] += both * square[kSquare[i][j]];
          }
        }
        for (int i = 0; i < 3; ++i) {
          step_.v[3 * k + i] += pull * s[i];
          for (int c = 0; c < 3; ++c) {
            const P x = qa[c] * s[i];
            P* row = vc_.data() + (3 * k + i) * colors_ + c * sites_;
            for (int l = 0; l < sites_; ++l) row[l] += x * w[l];
          }
        }
      }
      for (int k = 0; k < sites_; ++k) {
        const P q = s[6] * w[k];
        for (int l = 0; l <= k; ++l) cc_[pair(k, l)] += q * w[l];
        for (int c = 0; c < 3; ++c) step_.c[c * sites_ + k] += q * e[c];
      }
    }
  }
  // Solves the damped system by its Schur complement: first the colours, whose block is the same per channel.
  void step(const P& damping) {
    P mean(S(0));
    for (int i = 0; i < linear_; ++i) mean += vv_[pair(i, i)];
    for (int k = 0; k < sites_; ++k) mean += P(S(3)) * cc_[pair(k, k)];
    const P least = P(S(1e-4) / S(linear_ + colors_)) * mean + P(S(1e-8));
    for (int i = 0; i < linear_; ++i) vv_[pair(i, i)] += damping * (vv_[pair(i, i)] + least);
    for (int k = 0; k < sites_; ++k) cc_[pair(k, k)] += damping * (cc_[pair(k, k)] + least);
    factorize(cc_.data(), sites_);
    for (int c = 0; c < 3; ++c) solve(cc_.data(), sites_, step_.c + c * sites_);
    for (int i = 0; i < linear_; ++i) {
      P* row = vc_.data() + i * colors_;
      for (int c = 0; c < 3; ++c) solve(cc_.data(), sites_, row + c * sites_);
      for (int j = 0; j <= i; ++j) {
        P& x = vv_[pair(i, j)];
        for (int k = 0; k < colors_; ++k) x -= row[k] * vc_[j * colors_ + k];
      }
      for (int k = 0; k < colors_; ++k) step_.v[i] -= row[k] * step_.c[k];
    }
    factorize(vv_.data(), linear_);
    solve(vv_.data(), linear_, step_.v);
    solve_back(vv_.data(), linear_, step_.v);
    for (int i = 0; i < linear_; ++i) {
      for (int k = 0; k < colors_; ++k) step_.c[k] -= vc_[i * colors_ + k] * step_.v[i];
      next_.v[i] = now_.v[i] - step_.v[i];
    }
    for (int c = 0; c < 3; ++c) {
      solve_back(cc_.data(), sites_, step_.c + c * sites_);
      for (int k = 0; k < sites_; ++k) next_.c[3 * k + c] = now_.c[3 * k + c] - step_.c[c * sites_ + k];
    }
  }

  const FitSites<S>& a_;
  const int sites_, terms_, linear_, colors_;
  std::vector<P> samples_, vv_, cc_, vc_;
  Fit now_, next_, step_;  // colours of the step by channel
};

// Ranks the sites of surfels from `first` on: as many as there are lanes, or fewer at the end.
template <class S> void rank_lanes(const RankSites<S>& a, int64_t first, std::vector<Lanes<S>>& logits) {
  using P = Lanes<S>;
  const int count = int(std::min<int64_t>(kLanes, a.n - first)), sites = a.sites;
  const P zero = P(S(0)), least = P(S(1e-6));
  P vectors[3 * kMaxTerms], colors[3 * kMaxTerms], gone[kMaxTerms], w[kMaxTerms], cost[kMaxTerms];
  gather(a.vectors, first, count, 3 * sites, vectors), gather(a.colors, first, count, 3 * sites, colors);
  std::fill(gone, gone + sites, zero);
  std::vector<P> samples(4 * a.directions);
  gather(a.samples, first, count, 4 * a.directions, samples.data());
  logits.resize(a.directions * sites);
  for (int s = 0; s < a.directions; ++s)
    for (int k = 0; k < sites; ++k) {
      const P *d = &samples[4 * s], *v = vectors + 3 * k;
      logits[s * sites + k] = d[0] * v[0] + d[1] * v[1] + d[2] * v[2];
    }
  P left = P(S(sites * (sites - 1) / 2));  // sum of the indices of the sites left: at last that of one
  const auto put = [&](int place, const P& site) {
    for (int lane = 0; lane < count; ++lane) a.order[(first + lane) * sites + place] = int64_t(site[lane]);
  };
  for (int place = sites - 1; place > 0; --place) {
    std::fill(cost, cost + sites, zero);
    for (int s = 0; s < a.directions; ++s) {
      const P* logit = &logits[s * sites];
      P top = logit[0] + gone[0], sum = zero, c[3] = {zero, zero, zero};
      for (int k = 1; k < sites; ++k) top = max_(top, logit[k] + gone[k]);
      for (int k = 0; k < sites; ++k) w[k] = exp_(logit[k] + gone[k] - top), sum += w[k];
      const P share = P(S(1)) / sum;
      for (int k = 0; k < sites; ++k) {
        w[k] = w[k] * share;
        for (int i = 0; i < 3; ++i) c[i] += w[k] * colors[3 * k + i];
      }
      for (int k = 0; k < sites; ++k) {
        const P by = w[k] / max_(P(S(1)) - w[k], least);
        const P r = c[0] - colors[3 * k], g = c[1] - colors[3 * k + 1], b = c[2] - colors[3 * k + 2];
        cost[k] += samples[4 * s + 3] * (by * by) * (r * r + g * g + b * b);
      }
    }
    P found = P(S(-1)), lowest = zero;
    for (int k = 0; k < sites; ++k) {  // the first of the least; the last one if all are NaN
      const auto lower = (gone[k] >= zero) & (not_(found >= zero) | not_(cost[k] >= lowest));
      found = select(lower, P(S(k)), found), lowest = select(lower, cost[k], lowest);
    }
    for (int k = 0; k < sites; ++k) gone[k] = select((found >= P(S(k))) & (P(S(k)) >= found), P(S(-1e30)), gone[k]);
    left -= found;
    put(place, found);
  }
  put(0, left);
}
}  // namespace

template <class S> void fit_sites(const FitSites<S>& a) {
  const int64_t groups = (a.n + kLanes - 1) / kLanes;
  parallel_parts(groups, 1, [&](int, int64_t begin, int64_t end) {
    SiteLanes<S> lanes(a);
    for (int64_t group = begin; group < end; ++group) lanes.run(group * kLanes);
  });
}
template <class S> void rank_sites(const RankSites<S>& a) {
  parallel_parts((a.n + kLanes - 1) / kLanes, 1, [&](int, int64_t begin, int64_t end) {
    std::vector<Lanes<S>> logits;
    for (int64_t group = begin; group < end; ++group) rank_lanes(a, group * kLanes, logits);
  });
}
BT_INSTANTIATE(rank_sites, RankSites)
BT_INSTANTIATE(fit_sites, FitSites)

}  // namespace bt
