// Arguments of view colours and SSIM.
#pragma once

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

// Images [height, width, channels]; writes value [1] and, unless null, da.
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
