// Kernels with a fault that the emulator must find.
#pragma once

namespace bt::emulator {

int stale_numbers();            // how many threads find what a block before theirs left in shared memory
void open_barrier();            // threads wait for one that does not come
float read_float4(int offset);  // the second of four floats that begin so many floats behind a multiple of 16 bytes

}  // namespace bt::emulator
