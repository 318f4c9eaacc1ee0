// Fit of Spherical Voronoi colours, and the ranking of their sites, as operations take them.
#pragma once

#include "core/view_kinds.h"
#include "ops/arguments.h"

namespace bt {

// For n surfels: minimise sum over directions of weight |c(d) - target(d)|^2 over the vectors and the colours of their
// sites, by Levenberg-Marquardt. c is the mean of the sites' colours, weighted with softmax(vector . d); the first site
// has the vector 0.
template <class S> struct FitSites {
  int64_t n;
  int sites, directions, rounds;
  S *vectors, *colors;  // [n, sites - 1, 3], [n, sites, 3]: the start, replaced by the fit
  const S* samples;     // [n, directions, 7]: unit direction, target colour, weight

  template <class R> void fields(R& r) {
    r.numbers("sites", sites, "directions", directions, "rounds", rounds);
    if (sites < 2 || sites > kMaxTerms) r.refuse("a view colour has 2 to 32 sites");
    r.rows("colors", colors, n, 3 * sites);
    r.array("vectors", vectors, n * 3 * (sites - 1));
    r.array("samples", samples, n * 7 * directions);
  }
};

// For n surfels: rank the sites of a colour by how much they are needed. While more than one is left, that site goes
// without which the colour changes least: by w / (1 - w) (c - color), w its weight; weighted squares are summed over
// the directions.
template <class S> struct RankSites {
  int64_t n;
  int sites, directions;
  const S *vectors, *colors;  // [n, sites, 3] each; weights are softmax(vector . d)
  const S* samples;           // [n, directions, 4]: unit direction, weight
  int64_t* order;             // [n, sites]: the most needed first

  template <class R> void fields(R& r) {
    r.numbers("sites", sites, "directions", directions);
    if (sites < 1 || sites > kMaxTerms) r.refuse("a view colour has 1 to 32 sites");
    r.rows("colors", colors, n, 3 * sites);
    r.array("vectors", vectors, n * 3 * sites);
    r.array("samples", samples, n * 4 * directions);
    r.array("order", order, n * sites);
  }
};

}  // namespace bt
