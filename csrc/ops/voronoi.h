// Fit of Spherical Voronoi colours, and the ranking of their sites, as operations take them.
#pragma once

#include "core/view_kinds.h"
#include "ops/arguments.h"

namespace bt {

// Minimises, for each of n surfels, the sum over directions of weight |c(d) - target(d)|^2 over the vectors and colours
// of its sites, by Levenberg-Marquardt. c is the mean of the sites' colours, weighted by softmax(vector . d); the first
// site has the vector 0.
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

// Ranks the sites of each of n surfels by how much the colour needs them. While more than one is left, removes the site
// whose removal changes c least: by w / (1 - w) (c - color) for a site of weight w, squared and summed over the
// directions by their weights.
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
