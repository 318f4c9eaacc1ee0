// Walking a tile's surfels: a tile is 16 packs of 4 x 4 pixels.
#pragma once

#include "core/kernel.h"
#include "cpu/kernels.h"
#include "cpu/simd.h"

namespace bt {

constexpr int kPackSide = 4, kPacksAcross = kTile / kPackSide, kPacks = kPacksAcross * kPacksAcross;

// A pack's first pixel in its tile.
inline int pack_column(int pack) { return pack % kPacksAcross * kPackSide; }
inline int pack_row(int pack) { return pack / kPacksAcross * kPackSide; }

// A tile's transmittance while its surfels are drawn front to back.
template <class S>
struct TileState {
  using P = Pack<S>;
  using M = typename P::M;
  P transmittance[kPacks];
  M open[kPacks];  // pixels inside the image that still take light
  int open_packs = 0;
  S x0, y0;  // the tile's first pixel
  S stop;    // transmittance at which a pixel takes no more light
  P lane_x, lane_y;

  TileState(int tile_x, int tile_y, int width, int height, S stop = S(kTransmittanceMin)) : stop(stop) {
    x0 = S(tile_x * kTile), y0 = S(tile_y * kTile);
    for (int i = 0; i < kLanes; ++i) {
      lane_x.set(i, pixel_centre<S>(i % kPackSide));
      lane_y.set(i, pixel_centre<S>(i / kPackSide));
    }
    for (int p = 0; p < kPacks; ++p) {
      transmittance[p] = P(S(1));
      const P px = P(x0 + S(pack_column(p))) + lane_x, py = P(y0 + S(pack_row(p))) + lane_y;
      open[p] = (px < P(S(width))) & (py < P(S(height)));
      open_packs += bits(open[p]) != 0;
    }
  }

  // Blends a surfel: fn(pack, lanes, fragment, weight) for every pack in which some pixel takes it.
  template <class Kernel, class F>
  void blend(const S* g, const S* radius, S near, F&& fn, S sharp = S(1)) {
    const S cx = g[kCx] - x0, cy = g[kCy] - y0;
    const int left = first(cx - radius[0]), right = last(cx + radius[0]);
    const int top = first(cy - radius[1]), bottom = last(cy + radius[1]);
    for (int py = top; py <= bottom; ++py) {
      for (int px = left; px <= right; ++px) {
        const int pack = py * kPacksAcross + px;
        if (!bits(open[pack])) continue;
        const P dx = lane_x + P(S(px * kPackSide) - cx), dy = lane_y + P(S(py * kPackSide) - cy);
        if (filtered<Kernel>(g)) {
          const FilteredHit<P> at = filtered_hit<S, P>(g, dx, dy);
          if (bits(open[pack] & in_support(at))) take_fragment(pack, filtered_fragment<S, P>(g, near, at), fn);
          continue;
        }
        // a cheap look first: does any lane lie in the support or near the centre?
        const M inside = in_support(planes(g, dx, dy)), close = near_centre<Kernel>(dx, dy, sharp);
        if (!bits(open[pack] & (inside | close))) continue;
        take_fragment(pack, fragment<Kernel>(g, near, dx, dy, bits(close) != 0, sharp), fn);
      }
    }
  }

 private:
  template <class F>
  void take_fragment(int pack, const Fragment<P>& f, F& fn) {
    const Blend<P> b = bt::blend(f.sigma, transmittance[pack]);
    const BlendTest<P> v = blend_test(open[pack], f.sigma, b.behind, P(stop));
    if (!bits(v.takes | v.ends)) return;
    open[pack] = open[pack] & ~v.ends;
    transmittance[pack] = select(v.takes, b.behind, transmittance[pack]);
    const uint32_t lanes = bits(v.takes);
    if (lanes) fn(pack, lanes, f, b.weight);
    if (!bits(open[pack])) --open_packs;
  }
  static int first(S offset) {  // pack that holds the pixel at this offset, at least 0
    return offset <= S(0) ? 0 : int(offset) / kPackSide;
  }
  static int last(S offset) {
    if (offset < S(0)) return -1;
    return offset >= S(kTile) ? kPacksAcross - 1 : int(offset) / kPackSide;
  }
};

}  // namespace bt
