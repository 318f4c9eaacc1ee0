// View-dependent surfel colour f_view(d), without the offset 0.5: Spherical Voronoi (sv, Di Sario et al. 2025),
// spherical harmonics (sh, as in 3D Gaussian Splatting, Kerbl et al. 2023), Spherical Beta (sb, Deformable Beta
// Splatting, Liu et al. 2025) and spherical Gaussians (sg), each a struct with its vector-Jacobian product. d is the
// unit vector from the camera centre to the surfel, world frame.
#pragma once

#include "core/common.h"

namespace bt {

constexpr int kMaxTerms = 32;                  // sites or lobes
constexpr double kShC0 = 0.28209479177387814;  // harmonic of degree 0, 1 / (2 sqrt(pi)); below, degrees 1 to 3
constexpr double kShC1 = 0.4886025119029199;
constexpr double kShC2a = 1.0925484305920792, kShC2b = 0.31539156525252005, kShC2c = 0.5462742152960396;
constexpr double kShC3a = 0.5900435899266435, kShC3b = 2.890611442640554, kShC3c = 0.4570457994644658;
constexpr double kShC3e = 0.3731763325901154, kShC3f = 1.445305721320277;
constexpr double kLogTauMax = 16;    // temperatures up to 9e6, so that results are finite
constexpr double kLogPowerMax = 10;  // powers of Spherical Beta lobes up to 9e4

// Computes the temperature of a site or the sharpness of a Gaussian lobe.
template <class S> BT_HD S temperature(S log_tau) { return exp_(min_(log_tau, S(kLogTauMax))); }

// Numbers per surfel of the parameters a, b and c.
struct ViewColorWidths {
  int64_t a, b, c;
};
template <class S> struct ViewColorRow {
  S *a, *b, *c;
};

// Members of a kind's struct: name, fewest terms, and the preset's number of terms, for which kernels with unrolled
// loops are compiled; parameter widths; the colour, and its vector-Jacobian product, which writes the gradients of the
// parameters and adds to that of d; the reduced colour of a base and K terms of kReducedWidth numbers.

// Spherical Voronoi. a = sites [K, 3], b = log tau [K], c = rgb [K, 3].
struct SphericalVoronoi {
  static constexpr const char* kName = "sv";
  static constexpr int kLeastTerms = 1, kPresetTerms = 7, kReducedWidth = 6;
  BT_HD static ViewColorWidths widths(int K) { return {3 * K, K, 3 * K}; }

  // c = sum_k softmax_k(tau_k s_k . d) rgb_k, by log-sum-exp, so that any temperature is safe.
  template <class S> BT_HD static Vec3<S> color(int K, ViewColorRow<const S> p, Vec3<S> d) {
    const S *sites = p.a, *log_tau = p.b, *rgb = p.c;
    S logits[kMaxTerms], top = S(-1e30);
    for (int k = 0; k < K; ++k) {
      logits[k] = temperature(log_tau[k]) * dot(normalize(load3(sites + 3 * k)).n, d);
      top = max_(top, logits[k]);
    }
    Vec3<S> c = {S(0), S(0), S(0)};
    S total = S(0);
    for (int k = 0; k < K; ++k) {
      const S w = exp_(logits[k] - top);
      total += w;
      c = c + w * load3(rgb + 3 * k);
    }
    return (S(1) / total) * c;
  }
  // Relative to site 0, which then needs no direction: term k is b_k = tau_k s_k - tau_0 s_0 and rgb_k,
  // c = (base + sum_k exp(b_k . d) rgb_k) / (1 + sum_k exp(b_k . d)); the base alone without terms.
  template <class S> BT_HD static Vec3<S> reduced_color(int K, const S* base, const S* terms, Vec3<S> d) {
    Vec3<S> c = load3(base);
    if (K == 0) return c;
    S top = S(0);
    for (int k = 0; k < K; ++k) top = max_(top, dot(load3(terms + 6 * k), d));
    S total = exp_(-top);
    c = total * c;
    for (int k = 0; k < K; ++k) {
      const S w = exp_(dot(load3(terms + 6 * k), d) - top);
      total += w;
      c = c + w * load3(terms + 6 * k + 3);
    }
    return (S(1) / total) * c;
  }
  // dlogit_k = w_k dc . (rgb_k - c) is computed with colours relative to that of the heaviest site: if it has nearly
  // all weight, its rgb_k - c is then a sum of small terms, not a difference of equal colours, whose rounding a
  // temperature of 1e4 would amplify.
  template <class S>
  BT_HD static void color_vjp(int K, ViewColorRow<const S> p, Vec3<S> d, Vec3<S> dc, ViewColorRow<S> dp, Vec3<S>& dd) {
    const S *sites = p.a, *log_tau = p.b, *rgb = p.c;
    S *dsites = dp.a, *dlog_tau = dp.b, *drgb = dp.c;
    S w[kMaxTerms], tau[kMaxTerms], top = S(-1e30), total = S(0);
    Unit<S> site[kMaxTerms];
    Vec3<S> c = {S(0), S(0), S(0)}, pivot = load3(rgb);  // c relative to the pivot
    for (int k = 0; k < K; ++k) {
      site[k] = normalize(load3(sites + 3 * k));
      tau[k] = temperature(log_tau[k]);
      w[k] = tau[k] * dot(site[k].n, d);
      const MaskOf<S> heavier = w[k] > top;
      top = select(heavier, w[k], top), pivot = select(heavier, load3(rgb + 3 * k), pivot);
    }
    for (int k = 0; k < K; ++k) {
      w[k] = exp_(w[k] - top);
      total += w[k];
    }
    for (int k = 0; k < K; ++k) {
      w[k] = w[k] / total;
      c = c + w[k] * (load3(rgb + 3 * k) - pivot);
    }
    for (int k = 0; k < K; ++k) {
      store3(drgb + 3 * k, w[k] * dc);
      const S dlogit = w[k] * dot(dc, (load3(rgb + 3 * k) - pivot) - c);
      const S along = dot(site[k].n, d);
      dlog_tau[k] = select(log_tau[k] < S(kLogTauMax), dlogit * tau[k] * along, S(0));
      store3(dsites + 3 * k, normalize_vjp(site[k], (dlogit * tau[k]) * d));
      dd = dd + (dlogit * tau[k]) * site[k].n;
    }
  }
};

// Reduced form of a kind with unchanged terms. kInBase: terms in the base, 1 for spherical harmonics (degree 0).
template <class Kind, int kInBase = 0> struct StoredWhole {
  template <class S> BT_HD static Vec3<S> reduced_color(int K, const S* base, const S* terms, Vec3<S> d) {
    return Kind::color(K + kInBase, ViewColorRow<const S>{base, terms, nullptr}, d);
  }
};

// Computes real spherical harmonics up to degree 3 in the order and signs of 3DGS: the first `terms` of out [16].
template <class S> BT_HD void sh_basis(int terms, Vec3<S> d, S* out) {
  const S x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  out[0] = S(kShC0);
  if (terms > 1) {
    const S a = S(kShC1);
    out[1] = -a * y, out[2] = a * z, out[3] = -a * x;
  }
  if (terms > 4) {
    const S a = S(kShC2a), b = S(kShC2b), c = S(kShC2c);
    out[4] = a * x * y, out[5] = -a * y * z, out[6] = b * (S(2) * zz - xx - yy), out[7] = -a * x * z;
    out[8] = c * (xx - yy);
  }
  if (terms > 9) {
    const S a = S(kShC3a), b = S(kShC3b), c = S(kShC3c);
    const S e = S(kShC3e), f = S(kShC3f);
    out[9] = -a * y * (S(3) * xx - yy), out[10] = b * x * y * z, out[11] = -c * y * (S(4) * zz - xx - yy);
    out[12] = e * z * (S(2) * zz - S(3) * xx - S(3) * yy), out[13] = -c * x * (S(4) * zz - xx - yy);
    out[14] = f * z * (xx - yy), out[15] = -a * x * (xx - S(3) * yy);
  }
}
template <class S> BT_HD Vec3<S> sh_basis_vjp(int terms, Vec3<S> d, const S* g) {
  const S x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, two = S(2), six = S(6);
  Vec3<S> r = {S(0), S(0), S(0)};
  if (terms > 1) {
    const S a = S(kShC1);
    r.x -= a * g[3], r.y -= a * g[1], r.z += a * g[2];
  }
  if (terms > 4) {
    const S a = S(kShC2a), b = S(kShC2b), c = S(kShC2c);
    r.x += a * y * g[4] - two * b * x * g[6] - a * z * g[7] + two * c * x * g[8];
    r.y += a * x * g[4] - a * z * g[5] - two * b * y * g[6] - two * c * y * g[8];
    r.z += -a * y * g[5] + S(4) * b * z * g[6] - a * x * g[7];
  }
  if (terms > 9) {
    const S a = S(kShC3a), b = S(kShC3b), c = S(kShC3c);
    const S e = S(kShC3e), f = S(kShC3f);
    r.x += -a * six * x * y * g[9] + b * y * z * g[10] + two * c * x * y * g[11] - e * six * x * z * g[12] -
           c * (S(4) * zz - S(3) * xx - yy) * g[13] + two * f * x * z * g[14] - a * S(3) * (xx - yy) * g[15];
    r.y += -a * S(3) * (xx - yy) * g[9] + b * x * z * g[10] - c * (S(4) * zz - xx - S(3) * yy) * g[11] -
           e * six * y * z * g[12] + two * c * x * y * g[13] - two * f * y * z * g[14] + a * six * x * y * g[15];
    r.z += b * x * y * g[10] - S(8) * c * y * z * g[11] + e * (six * zz - S(3) * xx - S(3) * yy) * g[12] -
           S(8) * c * x * z * g[13] + f * (xx - yy) * g[14];
  }
  return r;
}
// Spherical harmonics with `terms` coefficients. a = dc [3], b = rest [terms - 1, 3].
struct SphericalHarmonics : StoredWhole<SphericalHarmonics, 1> {
  static constexpr const char* kName = "sh";
  static constexpr int kLeastTerms = 1, kPresetTerms = 16, kReducedWidth = 3;
  BT_HD static ViewColorWidths widths(int terms) { return {3, 3 * (terms - 1), 0}; }

  template <class S> BT_HD static Vec3<S> color(int terms, ViewColorRow<const S> p, Vec3<S> d) {
    const S *dc = p.a, *rest = p.b;
    S basis[16];
    sh_basis(terms, d, basis);
    Vec3<S> c = basis[0] * load3(dc);
    for (int k = 1; k < terms; ++k) c = c + basis[k] * load3(rest + 3 * (k - 1));
    return c;
  }
  template <class S>
  BT_HD static void color_vjp(int terms, ViewColorRow<const S> p, Vec3<S> d, Vec3<S> dc, ViewColorRow<S> dp,
                              Vec3<S>& dd) {
    const S* rest = p.b;
    S *ddc = dp.a, *drest = dp.b;
    S basis[16], g[16];
    sh_basis(terms, d, basis);
    store3(ddc, basis[0] * dc);
    g[0] = S(0);
    for (int k = 1; k < terms; ++k) {
      store3(drest + 3 * (k - 1), basis[k] * dc);
      g[k] = dot(dc, load3(rest + 3 * (k - 1)));
    }
    dd = dd + sh_basis_vjp(terms, d, g);
  }
};

// Softplus log(1 + exp(a x)) / a with a = 10 ln 2, 0.1 at 0 (lobe colours of Deformable Beta Splatting).
constexpr double kLobeSharpness = 6.931471805599453;
template <class S> BT_HD S lobe_softplus(S x) {
  const S a = S(kLobeSharpness) * x;
  const S big = a > S(0) ? a : S(0);
  return (big + log_(S(1) + exp_(a > S(0) ? -a : a))) / S(kLobeSharpness);
}

// Lobe of Spherical Beta, softplus(rgb) max(0, d . mu(theta, phi))^(4 exp(b)): six numbers rgb (3), theta, phi, b.
template <class S> struct BetaLobe {
  Vec3<S> mu, color;
  S st, ct, sp, cp, cosine, power, value;
};
template <class S> BT_HD BetaLobe<S> beta_lobe(const S* lobe, Vec3<S> d) {
  BetaLobe<S> l;
  l.st = sin_(lobe[3]), l.ct = cos_(lobe[3]), l.sp = sin_(lobe[4]), l.cp = cos_(lobe[4]);
  l.mu = {l.st * l.cp, l.st * l.sp, l.ct};
  l.color = {lobe_softplus(lobe[0]), lobe_softplus(lobe[1]), lobe_softplus(lobe[2])};
  l.cosine = dot(l.mu, d);
  l.power = S(4) * exp_(min_(lobe[5], S(kLogPowerMax)));
  l.value = l.cosine > S(0) ? exp_(l.power * log_(l.cosine)) : S(0);
  return l;
}
// Spherical Beta: c = base + sum of lobes. a = base [3], b = lobes [K, 6].
struct SphericalBeta : StoredWhole<SphericalBeta> {
  static constexpr const char* kName = "sb";
  static constexpr int kLeastTerms = 0, kPresetTerms = 2, kReducedWidth = 6;
  BT_HD static ViewColorWidths widths(int K) { return {3, 6 * K, 0}; }

  template <class S> BT_HD static Vec3<S> color(int K, ViewColorRow<const S> p, Vec3<S> d) {
    const S *base = p.a, *lobes = p.b;
    Vec3<S> c = load3(base);
    for (int k = 0; k < K; ++k) {
      const BetaLobe<S> l = beta_lobe(lobes + 6 * k, d);
      c = c + l.value * l.color;
    }
    return c;
  }
  template <class S>
  BT_HD static void color_vjp(int K, ViewColorRow<const S> p, Vec3<S> d, Vec3<S> dc, ViewColorRow<S> dp, Vec3<S>& dd) {
    const S* lobes = p.b;
    S *dbase = dp.a, *dlobes = dp.b;
    store3(dbase, dc);
    for (int k = 0; k < K; ++k) {
      const S* lobe = lobes + 6 * k;
      S* g = dlobes + 6 * k;
      const BetaLobe<S> l = beta_lobe(lobe, d);
      g[0] = l.value * dc.x * sigmoid(S(kLobeSharpness) * lobe[0]);
      g[1] = l.value * dc.y * sigmoid(S(kLobeSharpness) * lobe[1]);
      g[2] = l.value * dc.z * sigmoid(S(kLobeSharpness) * lobe[2]);
      const S dvalue = dot(dc, l.color);
      const bool lit = l.cosine > S(0);
      // clamped, as value / cosine diverges at 0 for powers below 1
      const S dcos = lit ? dvalue * l.power * l.value / max_(l.cosine, S(1e-6)) : S(0);
      g[5] = lit && lobe[5] < S(kLogPowerMax) ? dvalue * l.value * log_(l.cosine) * l.power : S(0);
      const Vec3<S> dmu = dcos * d;
      g[3] = dmu.x * l.ct * l.cp + dmu.y * l.ct * l.sp - dmu.z * l.st;
      g[4] = -dmu.x * l.st * l.sp + dmu.y * l.st * l.cp;
      dd = dd + dcos * l.mu;
    }
  }
};

// Spherical Gaussians: c = base + sum_k rgb_k exp(exp(l_k) (d . mu_k - 1)). a = base [3], b = lobes [K, 7]: mu (3,
// normalised), log sharpness, r, g, b.
struct SphericalGaussians : StoredWhole<SphericalGaussians> {
  static constexpr const char* kName = "sg";
  static constexpr int kLeastTerms = 0, kPresetTerms = 2, kReducedWidth = 7;
  BT_HD static ViewColorWidths widths(int K) { return {3, 7 * K, 0}; }

  template <class S> BT_HD static Vec3<S> color(int K, ViewColorRow<const S> p, Vec3<S> d) {
    const S *base = p.a, *lobes = p.b;
    Vec3<S> c = load3(base);
    for (int k = 0; k < K; ++k) {
      const S* lobe = lobes + 7 * k;
      const S sharp = temperature(lobe[3]);
      c = c + exp_(sharp * (dot(normalize(load3(lobe)).n, d) - S(1))) * load3(lobe + 4);
    }
    return c;
  }
  template <class S>
  BT_HD static void color_vjp(int K, ViewColorRow<const S> p, Vec3<S> d, Vec3<S> dc, ViewColorRow<S> dp, Vec3<S>& dd) {
    const S* lobes = p.b;
    S *dbase = dp.a, *dlobes = dp.b;
    store3(dbase, dc);
    for (int k = 0; k < K; ++k) {
      const S* lobe = lobes + 7 * k;
      S* g = dlobes + 7 * k;
      const Unit<S> mu = normalize(load3(lobe));
      const S sharp = temperature(lobe[3]), away = dot(mu.n, d) - S(1);
      const S value = exp_(sharp * away);
      store3(g + 4, value * dc);
      const S dexponent = value * dot(dc, load3(lobe + 4));
      g[3] = lobe[3] < S(kLogTauMax) ? dexponent * sharp * away : S(0);
      store3(g, normalize_vjp(mu, (dexponent * sharp) * d));
      dd = dd + (dexponent * sharp) * mu.n;
    }
  }
};

template <class... Kinds> struct ViewColorList {
  static constexpr const char* kNames[] = {Kinds::kName...};
};
// All kinds; in Python, `ops.view_kinds.VIEW_COLORS` has an entry for each.
using ViewColorKinds = ViewColorList<SphericalVoronoi, SphericalHarmonics, SphericalBeta, SphericalGaussians>;

}  // namespace bt
