// Entropy coding of integer columns: docs/baking.md, "Columns of integers".
#pragma once

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>

namespace bt {

// Layout of a column, a number per row, and what precedes it.
struct IntegerColumn {
  int64_t rows;
  // Number of blocks whose coefficients are the rows: coefficient 0 of every block, then coefficient 1, ... 0 = plain
  // rows.
  int64_t blocks;
  const uint8_t* others;  // [rows] sum of the magnitudes of this row's earlier numbers, at most 2; null without any
};

// Thrown for bytes that no encoder writes.
struct DamagedStream : std::runtime_error {
  using std::runtime_error::runtime_error;
};

constexpr int kIntegerBits = 52;  // of the largest magnitude

std::string encode_integers(const IntegerColumn& column, const int64_t* values);  // [rows]

// Throws DamagedStream.
void decode_integers(const IntegerColumn& column, const uint8_t* data, size_t bytes, int64_t* values);

}  // namespace bt
