// Working memory: the caller gives one block, a kernel's function cuts arrays from it.
#pragma once

#include <cstddef>
#include <cstdint>

namespace bt::cuda {

// Run with a null block it counts the bytes, with a block it hands out addresses: one description serves both.
class Arena {
 public:
  explicit Arena(void* block) : base_(reinterpret_cast<uintptr_t>(block)) {}
  template <class T>
  T* take(int64_t count) {
    const uintptr_t at = base_ + uintptr_t(used_);
    used_ += (count * int64_t(sizeof(T)) + kAlign - 1) / kAlign * kAlign;
    return reinterpret_cast<T*>(at);
  }
  int64_t used() const { return used_; }

 private:
  static constexpr int64_t kAlign = 256;  // what cudaMalloc gives
  uintptr_t base_;
  int64_t used_ = 0;
};

}  // namespace bt::cuda
