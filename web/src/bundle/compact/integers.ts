// Entropy-coded integers: docs/baking.md, "Columns of integers"; csrc/cpu/entropy.cpp writes them.
const PRECISION = 12; // log2 of the sum of a table's frequencies
const TOTAL = 1 << PRECISION;
const LOWEST = 1 << 23; // rANS states are from here to below 256 times as much
const FINE = 2; // bits of a token after the leading one
const MOST_DIRECT = 8;
const MOST_BITS = 52; // of a magnitude
const MOST_THRESHOLDS = 7;
const ORDERS = 3; // kinds of contexts
const LEVEL_BOUNDS = [3, 7, 13, 21, 32, 56, 96]; // of 16 times the running mean of magnitudes
// Context of a running mean up to the last bound.
const LEVELS = Uint8Array.from({ length: 97 }, (_, mean) => 1 + LEVEL_BOUNDS.filter((bound) => mean >= bound).length);
const OTHERS = 3; // values of `others`

class Bytes {
  private at = 0;
  constructor(private readonly data: Uint8Array) {}
  get left(): number {
    return this.data.length - this.at;
  }
  byte(): number {
    if (this.left === 0) throw new Error('it ends early');
    return this.data[this.at++];
  }
  number(most: number): number {
    let value = 0;
    for (let weight = 1; weight < 2 ** 63; weight *= 128) {
      const part = this.byte();
      value += (part & 127) * weight;
      if (part > 127) continue;
      if (value > most) throw new Error('a number is too large');
      return value;
    }
    throw new Error('a number is too long');
  }
  signed(): number {
    const value = this.number(2 ** (MOST_BITS + 1));
    return value % 2 ? -(value + 1) / 2 : value / 2;
  }
  rest(count: number): Uint8Array {
    if (count > this.left) throw new Error('it ends early');
    this.at += count;
    return this.data.subarray(this.at - count, this.at);
  }
}

// By slot: its token, and 2^12 times the token's frequency, plus the slot's index among the token's.
interface Table {
  tokens: Uint16Array;
  steps: Uint32Array;
}

function readTable(bytes: Bytes, most: number): Table | null {
  const count = bytes.number(most);
  const [tokens, steps] = [new Uint16Array(count ? TOTAL : 0), new Uint32Array(count ? TOTAL : 0)];
  let first = 0;
  for (let token = 0; token < count; token++) {
    const frequency = bytes.number(TOTAL);
    const zeros = frequency ? 0 : bytes.number(most);
    if (first + frequency > TOTAL || token + zeros >= count) throw new Error('a table is too long');
    tokens.fill(token, first, first + frequency);
    for (let k = 0; k < frequency; k++) steps[first + k] = frequency * TOTAL + k;
    first += frequency;
    token += zeros;
  }
  if (count && first !== TOTAL) throw new Error('a table is incomplete');
  return count ? { tokens, steps } : null;
}

// Decodes a number of every row of a column into `codes`. blocks: rows are coefficients of so many blocks, 0 = they are
// plain; others: sums of the magnitudes of the rows' earlier numbers, at most 2, null before the first.
export function decodeIntegers(
  data: Uint8Array,
  codes: Float64Array | Int32Array,
  blocks: number,
  others: Uint8Array | null,
): void {
  const bytes = new Bytes(data);
  const rows = codes.length;
  if (!rows) {
    if (data.length) throw new Error('something follows it');
    return;
  }
  const centre = bytes.signed();
  const [direct, order] = [bytes.byte(), bytes.byte()];
  if (direct < FINE || direct > MOST_DIRECT || order >= ORDERS) throw new Error('its head is of no kind');
  if (order === 2 && blocks && !others) throw new Error('its head is of no kind');
  const thresholds: number[] = [];
  if (order && !blocks) {
    for (let k = bytes.number(MOST_THRESHOLDS); k; k--) thresholds.push(bytes.signed());
    if (thresholds.some((x, k) => k && x < thresholds[k - 1])) throw new Error('its thresholds do not ascend');
  }
  const inBlocks = (LEVEL_BOUNDS.length + 2) * (order === 2 ? OTHERS : 1);
  const contexts = !order ? 1 : blocks ? inBlocks : thresholds.length + 1;
  const most = 2 * (2 ** direct + (MOST_BITS - direct) * 2 ** FINE) - 1;
  const tables = Array.from({ length: contexts }, () => readTable(bytes, most));
  const coded = bytes.rest(bytes.number(data.length));
  if (coded.length < 4) throw new Error('it ends early');
  let state = coded.subarray(0, 4).reduce((sum, byte) => sum * 256 + byte, 0);
  if (state < LOWEST || state >= LOWEST * 256) throw new Error('its state is out of range');
  const plain = bytes.rest(bytes.left);
  let [at, next] = [4, 0]; // bytes of `coded` and `plain` that are read
  let [held, count] = [0, 0]; // plain bits that are read, and not used
  const means = new Int32Array(order ? blocks : 0);
  let [before, earlier, block] = [0, 0, 0];
  for (let i = 0; i < rows; i++) {
    let context = 0;
    if (order && blocks) {
      if (i >= blocks) {
        context = LEVELS[Math.min(means[block], LEVELS.length - 1)];
      }
      if (order === 2) context = OTHERS * context + others![i];
    } else if (order) {
      const sum = before + (order === 2 ? earlier : 0);
      while (context < thresholds.length && thresholds[context] < sum) context++;
    }
    const table = tables[context];
    if (!table) throw new Error('a table is missing');
    const slot = state & (TOTAL - 1);
    const token = table.tokens[slot];
    const step = table.steps[slot];
    state = (step >>> PRECISION) * (state >>> PRECISION) + (step & (TOTAL - 1));
    while (state < LOWEST) {
      if (at === coded.length) throw new Error('it ends early');
      state = (state << 8) | coded[at++];
    }
    let magnitude = (token + 1) >> 1;
    if (magnitude >> direct) {
      const above = magnitude - (1 << direct);
      let rest = (above >> FINE) + direct - FINE;
      magnitude = ((1 << FINE) | (above & ((1 << FINE) - 1))) * 2 ** rest;
      for (let weight = 1; rest;) {
        if (!count) {
          if (next === plain.length) throw new Error('it ends early');
          [held, count] = [plain[next++], 8];
        }
        const part = rest < count ? rest : count;
        magnitude += (held & ((1 << part) - 1)) * weight;
        weight *= 1 << part;
        held >>= part;
        count -= part;
        rest -= part;
      }
    }
    const x = token & 1 ? -magnitude : magnitude;
    if (blocks && order) {
      means[block] += 4 * (magnitude < 255 ? magnitude : 255) - (means[block] >> 2);
      if (++block === blocks) block = 0;
    } else {
      earlier = before;
      before = x;
    }
    codes[i] = centre + x;
  }
  if (state !== LOWEST || at !== coded.length || next !== plain.length || held) {
    throw new Error('something follows it');
  }
}
