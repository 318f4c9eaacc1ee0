// Memory for large blocks.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace bt {

struct FreeMemory {
  void operator()(unsigned char* p) const { std::free(p); }
};
using Memory = std::unique_ptr<unsigned char, FreeMemory>;

// Memory that is not cleared. What is not written to takes none; with large pages (2 MB, where the system has them)
// writing for the first time costs far less time.
inline Memory allocate(size_t bytes, bool large_pages) {
  constexpr size_t kPage = size_t(1) << 21;
  bytes = (bytes + kPage - 1) / kPage * kPage;
  Memory memory(static_cast<unsigned char*>(std::aligned_alloc(kPage, bytes)));
  if (!memory) throw std::bad_alloc();
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  if (large_pages) madvise(memory.get(), bytes, MADV_HUGEPAGE);
#else
  (void)large_pages;
#endif
  return memory;
}

}  // namespace bt
