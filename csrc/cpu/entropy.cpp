// Integers as tokens, coded by rANS (Duda 2013) with a table of frequencies per context, and plain bits.

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <vector>

#include "cpu/kernels.h"

namespace bt {
namespace {
constexpr int kPrecision = 12;  // log2 of the sum of a table's frequencies
constexpr uint32_t kTotal = 1u << kPrecision;
constexpr uint32_t kLowest = 1u << 23;  // rANS states are from here to below 256 times as much
constexpr int kFine = 2;                // bits of a token after the leading one
constexpr int kDirect[] = {2, 7};       // magnitudes below 2^this are tokens of their own: choices of the encoder
constexpr int kFinest = 7;              // the largest of them, whose tokens imply those of the others
constexpr int kMostDirect = 8;
constexpr int kMostThresholds = 7;
constexpr int kOrders = 3;  // kinds of contexts
constexpr int kLevels = 8;  // of the magnitudes of a block's earlier coefficients
constexpr int kOthers = 3;  // values of `others`
constexpr int kLevelBounds[kLevels - 1] = {3, 7, 13, 21, 32, 56, 96};  // of 16 times their running mean

int bit_length(uint64_t x) { return x ? 64 - __builtin_clzll(x) : 0; }

// A number as a token and the lower `count` bits of its magnitude.
struct Token {
  int token, count;
  uint64_t bits;
};

Token split(int64_t x, int direct) {
  const uint64_t magnitude = x < 0 ? -uint64_t(x) : uint64_t(x);
  uint64_t kind = magnitude;
  int count = 0;
  if (magnitude >> direct) {
    const int length = bit_length(magnitude);
    count = length - 1 - kFine;
    kind = (uint64_t(1) << direct) + (uint64_t(length - direct - 1) << kFine) +
           ((magnitude >> count) & ((1 << kFine) - 1));
  }
  const uint64_t mask = (uint64_t(1) << count) - 1;
  return {int(2 * kind) - (x < 0), count, magnitude & mask};
}

int bits_after(int token, int direct) {
  const int kind = (token + 1) / 2, above = kind - (1 << direct);
  return above < 0 ? 0 : (above >> kFine) + direct - kFine;
}
// Converts a token for kFinest to the token for `direct` of the same numbers.
int coarser(int token, int direct) {
  const int kind = (token + 1) / 2, above = kind - (1 << kFinest), sign = token & 1;
  if (above < 0) return split(sign ? -kind : kind, direct).token;
  return token + 2 * ((1 << direct) + ((kFinest - direct) << kFine) - (1 << kFinest));
}

int tokens_of(int direct) { return 2 * ((1 << direct) + ((kIntegerBits - direct) << kFine)) - 1; }

// Chooses a table by what precedes a number in its column.
class Contexts {
 public:
  // order: 0 = one table. In blocks, 1 = by the running mean of the magnitudes of the block's earlier coefficients, 2 =
  // by `others` as well. In plain rows, by the sum of the previous number (1) or the previous two (2).
  Contexts(const IntegerColumn& column, int order, std::vector<int64_t> thresholds)
      : column_(column), order_(order), thresholds_(std::move(thresholds)) {
    if (column.blocks && order) means_.assign(column.blocks, 0);
  }
  int count() const {
    if (!order_) return 1;
    if (!column_.blocks) return int(thresholds_.size()) + 1;
    return (1 + kLevels) * (order_ == 2 ? kOthers : 1);
  }
  int at(int64_t row) const {
    if (!order_) return 0;
    if (!column_.blocks)
      return int(std::lower_bound(thresholds_.begin(), thresholds_.end(), sum()) - thresholds_.begin());
    int level = 0;
    if (row >= column_.blocks)
      for (level = 1; level < kLevels && means_[block_] >= kLevelBounds[level - 1];) ++level;
    return order_ == 2 ? kOthers * level + column_.others[row] : level;
  }
  void note(int64_t x) {
    before_ = {x, before_[0]};
    if (means_.empty()) return;
    int& mean = means_[block_];
    mean += int(4 * std::min<int64_t>(x < 0 ? -x : x, 255)) - (mean >> 2);
    if (++block_ == means_.size()) block_ = 0;
  }
  int64_t sum() const { return before_[0] + (order_ == 2 ? before_[1] : 0); }

 private:
  const IntegerColumn& column_;
  int order_;
  std::vector<int64_t> thresholds_;
  std::array<int64_t, 2> before_ = {0, 0};
  size_t block_ = 0;
  std::vector<int> means_;  // [blocks] 16 times the running mean of magnitudes
};

void put(std::string& to, uint64_t x) {  // seven bits per byte, lowest first
  for (; x >= 128; x >>= 7) to += char(x | 128);
  to += char(x);
}
void put_signed(std::string& to, int64_t x) { put(to, x < 0 ? 2 * (-uint64_t(x)) - 1 : 2 * uint64_t(x)); }

// Scales counts of tokens to frequencies that sum to kTotal, at least 1 for every token that occurs.
std::vector<uint32_t> normalised(const std::vector<uint32_t>& counts) {
  uint64_t sum = 0;
  for (uint32_t n : counts) sum += n;
  std::vector<uint32_t> found(counts.size());
  int64_t left = kTotal;
  for (size_t i = 0; i < counts.size(); ++i) {
    if (counts[i]) found[i] = std::max<uint32_t>(1, uint32_t(counts[i] * uint64_t(kTotal) / sum));
    left -= found[i];
  }
  while (left) {
    uint32_t& most = *std::max_element(found.begin(), found.end());
    const int64_t change = left > 0 ? left : -std::min<int64_t>(-left, most / 2);
    most += uint32_t(change), left -= change;
  }
  return found;
}

void put_table(std::string& to, const std::vector<uint32_t>& table) {
  size_t count = table.size();
  while (count && !table[count - 1]) --count;
  put(to, count);
  for (size_t i = 0; i < count; ++i) {
    put(to, table[i]);
    if (table[i]) continue;
    size_t more = i + 1;
    while (!table[more]) ++more;
    put(to, more - i - 1), i = more - 1;
  }
}

using Counts = std::vector<std::vector<uint32_t>>;  // of tokens, by context

// Occurrences of each token for kFinest in the contexts of an order.
struct Occurrences {
  int order;
  std::vector<int64_t> thresholds;
  Counts counts;
};

std::vector<int64_t> thresholds_of(const IntegerColumn& column, const int64_t* values, int64_t centre, int order) {
  Contexts contexts(column, order, {});
  std::vector<int64_t> sums(column.rows), found;
  for (int64_t i = 0; i < column.rows; ++i) sums[i] = contexts.sum(), contexts.note(values[i] - centre);
  std::sort(sums.begin(), sums.end());
  for (double share : {0.1, 0.25, 0.5, 0.75, 0.9}) found.push_back(sums[size_t(share * double(sums.size()))]);
  found.erase(std::unique(found.begin(), found.end()), found.end());
  return found;
}

Occurrences count(const IntegerColumn& column, const int64_t* values, int64_t centre, int order) {
  Occurrences found = {order, {}, {}};
  if (order && !column.blocks) found.thresholds = thresholds_of(column, values, centre, order);
  Contexts contexts(column, order, found.thresholds);
  found.counts.assign(contexts.count(), std::vector<uint32_t>(tokens_of(kFinest)));
  for (int64_t i = 0; i < column.rows; ++i) {
    const int64_t x = values[i] - centre;
    ++found.counts[contexts.at(i)][split(x, kFinest).token];
    contexts.note(x);
  }
  return found;
}
// In blocks, the contexts of an order are unions of those of the next.
std::vector<Occurrences> count_all(const IntegerColumn& column, const int64_t* values, int64_t centre) {
  std::vector<Occurrences> found(column.blocks && !column.others ? 2 : kOrders);
  for (int order = int(found.size()) - 1; order >= 0; --order) {
    if (!column.blocks || order + 1 == int(found.size())) {
      found[order] = count(column, values, centre, order);
      continue;
    }
    const Counts& finer = found[order + 1].counts;
    const size_t together = order ? kOthers : finer.size();
    Counts counts(finer.size() / together, std::vector<uint32_t>(tokens_of(kFinest)));
    for (size_t k = 0; k < finer.size(); ++k)
      for (size_t t = 0; t < finer[k].size(); ++t) counts[k / together][t] += finer[k][t];
    found[order] = {order, {}, std::move(counts)};
  }
  return found;
}

// Coding with a choice of `direct` and the order of `of`.
class Attempt {
 public:
  Attempt(const IntegerColumn& column, int64_t centre, int direct, const Occurrences& of)
      : direct_(direct), order_(of.order), centre_(centre), thresholds_(of.thresholds) {
    for (const auto& finest : of.counts) {
      std::vector<uint32_t> counts(tokens_of(direct));
      for (size_t t = 0; t < finest.size(); ++t)
        if (finest[t]) counts[coarser(int(t), direct)] += finest[t];
      uint64_t sum = 0;
      for (size_t t = 0; t < counts.size(); ++t)
        sum += counts[t], bits_ += double(uint64_t(counts[t]) * bits_after(int(t), direct));
      tables_.push_back(sum ? normalised(counts) : counts);
      for (size_t t = 0; t < counts.size(); ++t)
        if (counts[t]) bits_ += counts[t] * (kPrecision - std::log2(double(tables_.back()[t])));
    }
    put_signed(head_, centre);
    head_ += char(direct), head_ += char(order_);
    if (order_ && !column.blocks) {
      put(head_, thresholds_.size());
      for (int64_t threshold : thresholds_) put_signed(head_, threshold);
    }
    for (const auto& table : tables_) put_table(head_, table);
    bits_ += 8.0 * double(head_.size());
  }
  double bits() const { return bits_; }

  std::string encode(const IntegerColumn& column, const int64_t* values) const {
    std::vector<std::vector<uint32_t>> starts = tables_;
    for (auto& start : starts) {
      uint32_t sum = 0;
      for (uint32_t& f : start) std::swap(f, sum), sum += f;
    }
    std::vector<uint16_t> tokens(column.rows);
    std::vector<uint8_t> contexts(column.rows);
    std::string coded, plain;
    Contexts of(column, order_, thresholds_);
    uint64_t held = 0;
    int count = 0;
    for (int64_t i = 0; i < column.rows; ++i) {
      const int64_t x = values[i] - centre_;
      const Token token = split(x, direct_);
      tokens[i] = uint16_t(token.token), contexts[i] = uint8_t(of.at(i));
      of.note(x);
      held |= token.bits << count, count += token.count;
      for (; count >= 8; count -= 8, held >>= 8) plain += char(held);
    }
    if (count) plain += char(held);
    uint32_t state = kLowest;
    for (size_t i = tokens.size(); i-- > 0;) {  // backwards: rANS decodes first what was coded last
      const uint32_t frequency = tables_[contexts[i]][tokens[i]], start = starts[contexts[i]][tokens[i]];
      for (; state >= ((kLowest >> kPrecision) << 8) * uint64_t(frequency); state >>= 8) coded += char(state);
      state = (state / frequency << kPrecision) + state % frequency + start;
    }
    for (int k = 0; k < 4; ++k, state >>= 8) coded += char(state);
    std::reverse(coded.begin(), coded.end());
    std::string found = head_;
    put(found, coded.size());
    return found + coded + plain;
  }

 private:
  int direct_, order_;
  int64_t centre_;
  std::vector<int64_t> thresholds_;
  std::vector<std::vector<uint32_t>> tables_;  // per context
  std::string head_;
  double bits_ = 0;
};

[[noreturn]] void damaged(const char* why) { throw DamagedStream(why); }

class Bytes {
 public:
  Bytes(const uint8_t* at, const uint8_t* end) : at_(at), end_(end) {}
  size_t left() const { return size_t(end_ - at_); }
  uint32_t byte() {
    if (at_ == end_) damaged("it ends early");
    return *at_++;
  }
  uint64_t number(uint64_t most) {
    uint64_t x = 0;
    for (int shift = 0; shift < 63; shift += 7) {
      const uint64_t part = byte();
      x |= (part & 127) << shift;
      if (part < 128) {
        if (x > most) damaged("a number is too large");
        return x;
      }
    }
    damaged("a number is too long");
  }
  int64_t signed_number() {
    const uint64_t x = number(uint64_t(2) << kIntegerBits);
    return x & 1 ? -int64_t((x + 1) / 2) : int64_t(x / 2);
  }
  Bytes take(size_t count) {
    if (count > left()) damaged("it ends early");
    at_ += count;
    return {at_ - count, at_};
  }

 private:
  const uint8_t *at_, *end_;
};

// Token of every slot of a table; frequency and first slot of every token.
struct Slots {
  std::vector<uint16_t> tokens;
  std::vector<uint32_t> frequencies, starts;
};

Slots read_table(Bytes& bytes, int most) {
  Slots slots;
  const size_t count = bytes.number(uint64_t(most));
  while (slots.frequencies.size() < count) {
    const uint32_t frequency = uint32_t(bytes.number(kTotal));
    const size_t first = slots.tokens.size(), zeros = frequency ? 0 : bytes.number(uint64_t(most));
    if (first + frequency > kTotal || slots.frequencies.size() + zeros >= count) damaged("a table is too long");
    slots.tokens.insert(slots.tokens.end(), frequency, uint16_t(slots.frequencies.size()));
    slots.frequencies.insert(slots.frequencies.end(), 1 + zeros, frequency);
    slots.starts.insert(slots.starts.end(), 1 + zeros, uint32_t(first));
  }
  if (count && slots.tokens.size() != kTotal) damaged("a table is incomplete");
  return slots;
}

}  // namespace

std::string encode_integers(const IntegerColumn& column, const int64_t* values) {
  if (!column.rows) return {};
  std::vector<int64_t> sorted(values, values + column.rows);
  std::nth_element(sorted.begin(), sorted.begin() + column.rows / 2, sorted.end());
  const int64_t centre = column.blocks ? 0 : sorted[size_t(column.rows / 2)];
  const std::vector<Occurrences> orders = count_all(column, values, centre);
  std::optional<Attempt> best;
  for (int direct : kDirect)
    for (const Occurrences& of : orders) {
      Attempt attempt(column, centre, direct, of);
      if (!best || attempt.bits() < best->bits()) best.emplace(std::move(attempt));
    }
  return best->encode(column, values);
}

void decode_integers(const IntegerColumn& column, const uint8_t* data, size_t size, int64_t* values) {
  Bytes bytes(data, data + size);
  if (!column.rows) {
    if (size) damaged("something follows it");
    return;
  }
  const int64_t centre = bytes.signed_number();
  const int direct = int(bytes.byte()), order = int(bytes.byte());
  if (direct < kFine || direct > kMostDirect || order >= kOrders) damaged("its head is of no kind");
  if (order == 2 && column.blocks && !column.others) damaged("its head is of no kind");
  std::vector<int64_t> thresholds;
  if (order && !column.blocks) {
    thresholds.resize(bytes.number(kMostThresholds));
    for (int64_t& threshold : thresholds) threshold = bytes.signed_number();
    if (!std::is_sorted(thresholds.begin(), thresholds.end())) damaged("its thresholds do not ascend");
  }
  Contexts contexts(column, order, thresholds);
  std::vector<Slots> tables;
  for (int k = 0; k < contexts.count(); ++k) tables.push_back(read_table(bytes, tokens_of(direct)));
  Bytes coded = bytes.take(bytes.number(size));
  uint32_t state = 0;
  for (int k = 0; k < 4; ++k) state = state << 8 | coded.byte();
  if (state < kLowest || state >= kLowest << 8) damaged("its state is out of range");
  uint64_t held = 0;
  int count = 0;
  for (int64_t i = 0; i < column.rows; ++i) {
    const Slots& table = tables[size_t(contexts.at(i))];
    if (table.tokens.empty()) damaged("a table is missing");
    const uint32_t slot = state & (kTotal - 1), token = table.tokens[slot];
    state = table.frequencies[token] * (state >> kPrecision) + slot - table.starts[token];
    while (state < kLowest) state = state << 8 | coded.byte();
    uint64_t magnitude = (token + 1) / 2;
    if (magnitude >> direct) {
      const uint64_t above = magnitude - (uint64_t(1) << direct);
      const int rest = int(above >> kFine) + direct - kFine;
      for (; count < rest; count += 8) held |= uint64_t(bytes.byte()) << count;
      const uint64_t top = (uint64_t(1) << kFine) | (above & ((1 << kFine) - 1));
      magnitude = top << rest | (held & ((uint64_t(1) << rest) - 1));
      held >>= rest, count -= rest;
    }
    const int64_t x = token & 1 ? -int64_t(magnitude) : int64_t(magnitude);
    contexts.note(x);
    values[i] = centre + x;
  }
  if (state != kLowest || coded.left() || bytes.left() || held) damaged("something follows it");
}

}  // namespace bt
