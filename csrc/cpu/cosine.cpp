// Cosine transform of texel blocks: forward with a lane per block and channel, inverse with a lane per block.
#include "cpu/kernels.h"
#include "cpu/simd.h"

namespace bt {

namespace {
constexpr int kArea = kCosines * kCosines;

template <class S> void product(const S* matrix, int n, bool back, const Lanes<S>* from, Lanes<S>* to, int apart) {
  const int by_row = back ? 1 : n, by_column = back ? n : 1;
  for (int k = 0; k < n; ++k) {
    Lanes<S> sum = Lanes<S>(matrix[k * by_row]) * from[0];
    for (int i = 1; i < n; ++i) sum += Lanes<S>(matrix[k * by_row + i * by_column]) * from[i * apart];
    to[k * apart] = sum;
  }
}

// Transforms a block along u, then along v; `back`: with the transposed matrices.
template <class S> void transform(const CosineBlocks<S>& a, const Lanes<S>* from, Lanes<S>* to, bool back) {
  Lanes<S> half[kArea];
  for (int v = 0; v < a.height; ++v) product(a.across, a.width, back, from + v * a.width, half + v * a.width, 1);
  for (int u = 0; u < a.width; ++u) product(a.down, a.height, back, half + u, to + u, a.width);
}

template <class S> class BlockLanes {
  using P = Lanes<S>;

 public:
  explicit BlockLanes(const SparseCosines<S>& a) : a_(a), area_(a.height * a.width) {}

  // Solves for consecutive (block, channel) pairs from `first` on, up to the number of lanes.
  void run(int64_t first) {
    const int count = int(std::min<int64_t>(kLanes, a_.blocks * a_.channels - first));
    gather(first, count);
    transform(a_, target_, value_, false);
    for (int round = 0; round < a_.rounds; ++round) {
      transform(a_, value_, texel_, true);
      for (int i = 0; i < area_; ++i) texel_[i] = pull_[i] * (target_[i] - texel_[i]);
      transform(a_, texel_, change_, false);
      value_[0] = value_[0] + change_[0];
      for (int i = 1; i < area_; ++i) value_[i] = shrunk(value_[i] + change_[i]);
    }
    for (int k = 0; k < area_; ++k) {
      const P x = value_[a_.order[k]] / step_, whole = floor_(max_(x, -x) + P(S(0.5)));
      alignas(64) S steps[kLanes];
      store(steps, select(x < P(S(0)), -whole, whole));
      int32_t* to = a_.codes + k * a_.blocks * a_.channels + first;
      for (int lane = 0; lane < count; ++lane) to[lane] = int32_t(steps[lane]);
    }
  }

 private:
  void gather(int64_t first, int count) {
    alignas(64) S value[kLanes], weight[kLanes], step[kLanes] = {};
    P most(S(0)), sum(S(0));
    for (int i = 0; i < area_; ++i) {
      for (int lane = 0; lane < kLanes; ++lane) {
        const int64_t item = first + std::min(lane, count - 1), block = item / a_.channels, tile = a_.tile[block];
        const int64_t row = a_.rows[block * area_ + i];
        const S* mix = a_.mix + item % a_.channels * a_.channels;
        value[lane] = 0, weight[lane] = a_.weights[row], step[lane] = a_.step[tile];
        for (int c = 0; c < a_.channels; ++c)
          value[lane] += mix[c] * (a_.values[row * a_.channels + c] - a_.mean[tile * a_.channels + c]);
      }
      target_[i] = load(value), pull_[i] = load(weight);
      most = max_(most, pull_[i]), sum = sum + pull_[i];
    }
    step_ = load(step);
    threshold_ = P(a_.shrink / area_) * step_ * sum / most;
    for (int i = 0; i < area_; ++i) pull_[i] = pull_[i] / most;
  }
  P shrunk(P x) const {
    const P rest = max_(max_(x, -x) - threshold_, P(S(0)));
    return select(x < P(S(0)), -rest, rest);
  }

  const SparseCosines<S>& a_;
  const int area_;
  P step_, threshold_;
  P target_[kArea], pull_[kArea], value_[kArea], texel_[kArea], change_[kArea];
};

// Decodes consecutive blocks from `first` on, up to the number of lanes.
template <class S> void decode(const DecodeCosines<S>& a, int64_t first) {
  using P = Lanes<S>;
  const int count = int(std::min<int64_t>(kLanes, a.blocks - first)), area = a.height * a.width;
  alignas(64) S lanes[kLanes];
  P value[kArea], channel[kMostChannels][kArea];
  for (int c = 0; c < a.channels; ++c) {
    for (int k = 0; k < area; ++k) {
      const int32_t* from = a.codes + (k * a.blocks + first) * a.channels + c;
      for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = S(from[std::min(lane, count - 1) * a.channels]);
      value[a.order[k]] = load(lanes);
    }
    transform(a, value, channel[c], true);
  }
  for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = a.step[a.tile[first + std::min(lane, count - 1)]];
  const P step = load(lanes);
  for (int i = 0; i < area; ++i)
    for (int c = 0; c < a.channels; ++c) {
      P sum(S(0));
      for (int from = 0; from < a.channels; ++from) sum += P(a.mix[from * a.channels + c]) * channel[from][i];
      store(lanes, sum * step);
      for (int lane = 0; lane < count; ++lane) {
        const int64_t block = first + lane;
        a.values[a.rows[block * area + i] * a.channels + c] = lanes[lane] + a.mean[a.tile[block] * a.channels + c];
      }
    }
}
}  // namespace

template <class S> void sparse_cosines(const SparseCosines<S>& a) {
  const int64_t groups = (a.blocks * a.channels + kLanes - 1) / kLanes;
  parallel_parts(groups, 8, [&](int, int64_t begin, int64_t end) {
    BlockLanes<S> lanes(a);
    for (int64_t group = begin; group < end; ++group) lanes.run(group * kLanes);
  });
}
BT_INSTANTIATE(sparse_cosines, SparseCosines)

template <class S> void decode_cosines(const DecodeCosines<S>& a) {
  parallel_each((a.blocks + kLanes - 1) / kLanes, 8, [&](int64_t group) { decode(a, group * kLanes); });
}
BT_INSTANTIATE(decode_cosines, DecodeCosines)

}  // namespace bt
