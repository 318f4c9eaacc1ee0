// Sorts (key, value) pairs stably by 4 bits of the key, lowest first; eight rounds sort completely. Each round has three
// kernels, as workgroups of one dispatch must not wait for each other: forward progress is not guaranteed.
//
//   count    histogram of digits per block of 1,024 keys
//   scan     first output position per digit and block
//   scatter  moves the pairs

const THREADS: u32 = 256;
const PER_THREAD: u32 = 4;
const BLOCK: u32 = 1024;
const DIGITS: u32 = 16;

struct Round {
  count: u32,
  blocks: u32,
  shift: u32,
  unused: u32,
}

@group(0) @binding(0) var<uniform> round: Round;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> table: array<u32>;  // by digit, then by block

var<workgroup> totals: array<atomic<u32>, DIGITS>;

@compute @workgroup_size(THREADS)
fn count(@builtin(local_invocation_index) thread: u32, @builtin(workgroup_id) group: vec3u) {
  if thread < DIGITS { atomicStore(&totals[thread], 0u); }
  workgroupBarrier();
  for (var k = 0u; k < PER_THREAD; k++) {
    let at = group.x * BLOCK + k * THREADS + thread;
    if at < round.count { atomicAdd(&totals[(keys_in[at] >> round.shift) & (DIGITS - 1)], 1u); }
  }
  workgroupBarrier();
  if thread < DIGITS { table[thread * round.blocks + group.x] = atomicLoad(&totals[thread]); }
}

var<workgroup> sums: array<u32, THREADS>;

// Scans the table in one workgroup; each thread takes a run.
@compute @workgroup_size(THREADS)
fn scan(@builtin(local_invocation_index) thread: u32) {
  let size = DIGITS * round.blocks;
  let run = (size + THREADS - 1) / THREADS;
  let begin = min(thread * run, size);
  let end = min(begin + run, size);
  var total = 0u;
  for (var i = begin; i < end; i++) { total += table[i]; }
  sums[thread] = total;
  for (var step = 1u; step < THREADS; step *= 2) {
    workgroupBarrier();
    var other = 0u;
    if thread >= step { other = sums[thread - step]; }
    workgroupBarrier();
    sums[thread] += other;
  }
  var before = sums[thread] - total;
  for (var i = begin; i < end; i++) {
    let size = table[i];
    table[i] = before;
    before += size;
  }
}

// 16-bit counters of 16 digits: digit d in half d % 2 of word d / 2.
struct Counts {
  low: vec4u,
  high: vec4u,
}
var<workgroup> counts: array<Counts, THREADS>;

fn one(digit: u32) -> Counts {
  let value = 1u << (16 * (digit & 1));
  let lanes = vec4u(0, 1, 2, 3) == vec4u((digit >> 1) & 3);
  let word = select(vec4u(0), vec4u(value), lanes);
  return Counts(select(vec4u(0), word, digit < 8), select(vec4u(0), word, digit >= 8));
}
fn of_digit(c: Counts, digit: u32) -> u32 {
  let words = select(c.high, c.low, digit < 8);
  return (words[(digit >> 1) & 3] >> (16 * (digit & 1))) & 0xffff;
}

@compute @workgroup_size(THREADS)
fn scatter(@builtin(local_invocation_index) thread: u32, @builtin(workgroup_id) group: vec3u) {
  let first = group.x * BLOCK + thread * PER_THREAD;
  var mine = Counts(vec4u(0), vec4u(0));
  for (var k = 0u; k < PER_THREAD; k++) {
    if first + k < round.count {
      let c = one((keys_in[first + k] >> round.shift) & (DIGITS - 1));
      mine = Counts(mine.low + c.low, mine.high + c.high);
    }
  }
  counts[thread] = mine;
  for (var step = 1u; step < THREADS; step *= 2) {
    workgroupBarrier();
    var other = Counts(vec4u(0), vec4u(0));
    if thread >= step { other = counts[thread - step]; }
    workgroupBarrier();
    counts[thread] = Counts(counts[thread].low + other.low, counts[thread].high + other.high);
  }
  var before = Counts(counts[thread].low - mine.low, counts[thread].high - mine.high);
  for (var k = 0u; k < PER_THREAD; k++) {
    if first + k >= round.count { break; }
    let key = keys_in[first + k];
    let digit = (key >> round.shift) & (DIGITS - 1);
    let to = table[digit * round.blocks + group.x] + of_digit(before, digit);
    keys_out[to] = key;
    values_out[to] = values_in[first + k];
    let c = one(digit);
    before = Counts(before.low + c.low, before.high + c.high);
  }
}
