// Arguments of view colours and SSIM.
#pragma once

#include "core/training.h"
#include "core/view_color.h"
#include "ops/arguments.h"

namespace bt {

// Directions from the camera centre [3] to means [n, 3]. Rows with active [n] = 0 give 0 and get gradient 0.
template <class S> struct Directions {
  int64_t n;
  const S* means;
  const double* center;
  const uint8_t* active;

  template <class R> void fields(R& r) {
    r.rows("active", active, n, 1);
    r.array("means", means, 3 * n);
    r.array("center", center, 3);
  }
};

template <class S> struct ViewColorForward {
  Directions<S> to;
  ViewColors<S> colors;
  S* out;  // [n, 3]

  template <class R> void fields(R& r) {
    to.fields(r);
    colors.fields(r, to.n);
    r.array("out", out, 3 * to.n);
  }
};

template <class S> struct ViewColorBackward {
  Directions<S> to;
  ViewColorArrays<const S> colors;
  const S* dout;
  ViewColorArrays<S> dcolors;
  S* dmeans;

  template <class R> void fields(R& r) {
    to.fields(r);
    colors.fields(r, to.n);
    r.array("dout", dout, 3 * to.n);
    dcolors.kind = colors.kind, dcolors.terms = colors.terms;
    dcolors.arrays(r, to.n, "da", "db", "dc");
    r.array("dmeans", dmeans, 3 * to.n);
  }
};

// Adam step number `step`, from 1, on row `number` of the photographs' corrections, table [photographs, width], by the
// gradient [width] with respect to the correction (gains, not log gains). Unless settle is 0, all rows are then made
// admissible, as by `train.exposure.settled`.
template <class S> struct LearnExposure {
  int64_t photographs, number;
  int width, settle;
  S *table, *mean, *square;
  const S* gradient;
  double rate, beta1, beta2, eps, step;
  S limit, other_limit;  // of log gains and other entries

  template <class R> void fields(R& r) {
    r.numbers("photographs", photographs, "width", width, "number", number, "settle", settle);
    if ((width != 3 && width != 12) || number < 0 || number >= photographs) r.refuse("there is no such correction");
    r.arrays(photographs * width, "table", table, "mean", mean, "square", square);
    r.array("gradient", gradient, width);
    r.numbers("rate", rate, "beta1", beta1, "beta2", beta2, "eps", eps, "step", step);
    r.numbers("limit", limit, "other_limit", other_limit);
  }
  BT_HD S limit_of(int column) const { return is_log_gain(width, column) ? limit : other_limit; }
  BT_HD void move(int column) const {
    const int64_t at = number * width + column;
    const S value = gradient[column], chained = is_log_gain(width, column) ? value * S(exp(table[at])) : value;
    const AdamRates<S> rates = adam_rates<S>(rate, beta1, beta2, eps, step);
    table[at] += adam_step(rates, chained - chained == S(0) ? chained : S(0), mean[at], square[at]);
  }
};

// Mean SSIM of images a and b [height, width, channels] to value [1], and its gradient to da unless that is null.
template <class S> struct Ssim {
  int height, width, channels;
  const S *a, *b;
  S *value, *da;
  Workspace workspace;

  template <class R> void fields(R& r) {
    r.numbers("height", height, "width", width, "channels", channels);
    const int64_t size = int64_t(height) * width * channels;
    r.arrays(size, "a", a, "b", b);
    r.array("value", value, 1);
    r.maybe("da", da, size);
    r.memory("workspace", workspace);
  }
};

}  // namespace bt
