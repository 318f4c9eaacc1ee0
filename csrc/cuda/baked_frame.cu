// Host side of a frame: working memory and stages.
#include <stdexcept>
#include <string>

#include "cuda/baked_stages.h"

namespace bt::cuda {

namespace {
constexpr int kLong = 2;         // a long list has more than this times the mean capacity,
constexpr int kLeastLong = 128;  // and at least this many pairs

// Divides the working memory into arrays; returns the bytes needed. With a null base it only counts.
int64_t lay_out(BakedFrame& f, void* base, bool normals) {
  Arena arena(base);
  BakedMemory& m = f.memory;
  m.total = arena.take<int64_t>(4), m.spilled_count = m.total + 1, m.rest_count = m.total + 2;
  m.large_count = reinterpret_cast<int32_t*>(m.total + 3), m.long_count = m.large_count + 1;
  m.lists = arena.take<TileList>(f.tiles);
  m.cleared = arena.used();
  m.rows = arena.take<float>(f.rows * kRow);
  m.normals = normals ? arena.take<float4>(f.rows) : nullptr;
  m.depth = arena.take<uint32_t>(f.rows);
  m.pairs = arena.take<uint32_t>(f.tiles * f.slots + f.capacity);
  m.spilled = arena.take<SpilledPair>(f.capacity);
  m.large = arena.take<uint32_t>(f.rows), m.long_tiles = arena.take<uint32_t>(f.tiles);
  return arena.used();
}

BakedFrame frame_of(int64_t surfels, const BakedViews& v, int slots, int64_t capacity) {
  BakedFrame f = {};
  f.n = surfels, f.rows = surfels * v.count;
  f.width = v.width, f.height = v.height;
  f.tiles_x = tiles_across(v.width), f.tiles_y = tiles_across(v.height);
  f.tiles = int64_t(f.tiles_x) * f.tiles_y * v.count;
  f.slots = slots, f.capacity = max_<int64_t>(capacity, 1);
  if (slots < kWarp || slots % kWarp)
    throw std::invalid_argument("a tile has " + std::to_string(slots) + " slots, it needs a multiple of " +
                                std::to_string(kWarp));
  f.long_from = int(max_<int64_t>(kLong * f.capacity / max_<int64_t>(f.tiles, 1), kLeastLong));
  if (f.rows > kMostRows)
    throw std::invalid_argument("surfels times views is " + std::to_string(f.rows) + ", at most " +
                                std::to_string(kMostRows) + " are drawn in one call: draw fewer views at once");
  // pair indices have 32 bits
  if (f.capacity > kMostPairs || f.tiles > kMostPairs / slots || v.count > 65535)
    throw std::invalid_argument(
        "too many views, pixels or pairs of surfel and tile for one call: draw fewer views at "
        "once, or smaller ones");
  return f;
}
}  // namespace

size_t baked_memory(int64_t surfels, const BakedViews& views, int slots, int64_t capacity, bool normals) {
  BakedFrame f = frame_of(surfels, views, slots, capacity);
  return lay_out(f, nullptr, normals);
}

void baked_frame(const BakedDraw& a, Stream stream) {
  BakedFrame f = frame_of(a.scene->geometry.n, a.views, a.slots, a.capacity);
  f.photo_pixel = a.photo_pixel;
  const int64_t needed = lay_out(f, a.memory.at, a.images.normal != nullptr);
  if (a.memory.bytes < needed)
    throw std::invalid_argument("the working memory has " + std::to_string(a.memory.bytes) +
                                " bytes, the frame needs " + std::to_string(needed));
  if (f.rows && a.stages & kList) baked_list(*a.scene, a.views, f, stream);
  if (a.stages & kDraw) baked_draw(*a.scene, a.images, f, stream);
}

}  // namespace bt::cuda
