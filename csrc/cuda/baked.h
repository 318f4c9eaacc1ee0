// Forward-only renderer of a baked scene on the device.
//
//   list      one thread per surfel: projection, level set, bounds; for visible ones also the view colour and the tile
//             of the atlas. Writes a row of 24 floats, all that later stages read. A pair of surfel and tile takes
//             the next slot of its tile; when the tile's slots are full, it goes to a list shared by all tiles.
//   draw      a block per tile of 16 x 16 pixels sorts the tile's list front to back (ties by the surfel's index);
//             then one warp per 8 x 8 pixels, two per thread. A pair has the mask of the 8 x 4 parts of the tile that
//             its surfel reaches, so a warp reads only its own pairs.
//
// Nothing is allocated and nothing waits: counts stay on the device. Pairs that do not fit are counted; their surfels
// are missing, and the frame must be drawn again with more capacity.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/surfel.h"
#include "core/texel.h"
#include "core/view_color.h"
#include "cuda/device.h"
#include "ops/texel.h"

namespace bt::cuda {

class AtlasTexture;

// A baked scene in the kernels' form.
struct BakedScene : BakedResidual {
  Surfels<float> geometry;
  ViewColors<float> colors;
  const int32_t* tiles;  // [n, 5]: x, y, page, r_u, r_v; r_u = 0: no tile
  // The atlas, and the levels of its tiles (core/texel.h) for views smaller than the photographs; null: none. Host
  // objects, kept by Python.
  const AtlasTexture* levels[kTileLevels];
  int pages_down, page_width, page_height;  // pages per column, and their pitch
  float near;

  template <class R>  // as in ops/arguments.h
  void fields(R& r) {
    geometry.fields(r);
    const int64_t n = geometry.n;
    colors.fields(r, n);
    r.array("tiles", tiles, 5 * n);
    r.maybe_object("texture", levels[0]);
    r.maybe_object("half", levels[1]);
    r.maybe_object("quarter", levels[2]);
    pages_down = 1, page_width = page_height = 0;
    if (levels[0]) r.numbers("pages_down", pages_down, "page_width", page_width, "page_height", page_height);
    BakedResidual::fields(r, n);
    r.number("near", near);
  }
};

struct BakedViews {
  int count, width, height;
  const float *viewmats, *Ks;  // [count, 16], [count, 9]
};

// Images [count, height, width, channels]; null: not drawn.
struct BakedImages {
  float *rgb, *alpha;            // 3 channels over the background, 1
  uint32_t* packed;              // the same as 8 bits per channel, red in the lowest byte
  float *beta, *depth, *normal;  // sums of w beta, w z and w n (1, 1 and 3 channels)
  int32_t* overdraw;             // blended surfels
  const float* background;       // [3], null: black

  template <class R> void fields(R& r, int64_t pixels) {
    r.maybe("rgb", rgb, 3 * pixels);
    r.maybes(pixels, "alpha", alpha, "packed", packed, "beta", beta, "depth", depth);
    r.maybe("normal", normal, 3 * pixels);
    r.maybe("overdraw", overdraw, pixels);
    r.maybe("background", background, 3);
  }
};

enum BakedStage { kList = 1, kDraw = 2 };

constexpr int64_t kMostRows = int64_t(1) << 24;  // surfels times views: a pair has 24 bits of row and 8 of mask
constexpr int64_t kMostPairs = (int64_t(1) << 31) - 1024;

// Returns the bytes of working memory. After a frame it begins with two int64: the number of pairs, and the number of
// those without a slot. If the latter exceeds `capacity`, the frame is incomplete.
size_t baked_memory(int64_t surfels, const BakedViews& views, int slots, int64_t capacity, bool normals);

// A frame of all views. stages: a sum of BakedStage; each needs the results of earlier ones in `memory`.
struct BakedDraw {
  const BakedScene* scene;
  BakedViews views;
  BakedImages images;
  int stages;
  float photo_pixel;  // side of a photograph's pixel in pixels of the views
  Workspace memory;
  int slots;         // per screen tile, for pairs; a multiple of 32
  int64_t capacity;  // pairs without a slot that fit

  template <class R> void fields(R& r) {
    r.object("scene", scene);
    int64_t count;
    r.rows("viewmats", views.viewmats, count, 16);
    views.count = int(count);
    r.array("Ks", views.Ks, 9 * count);
    r.numbers("width", views.width, "height", views.height);
    images.fields(r, count * views.width * views.height);
    r.numbers("stages", stages, "photo_pixel", photo_pixel);
    r.memory("memory", memory);
    r.numbers("slots", slots, "capacity", capacity);
  }
};
void baked_frame(const BakedDraw& a, Stream stream);

}  // namespace bt::cuda
