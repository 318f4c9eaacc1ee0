// Columns of entropy-coded integers: docs/baking.md, "Columns of integers"; csrc/cpu/entropy.cpp writes them.
import { DamagedBundle, messageOf } from '../../errors';

const PRECISION = 12; // log2 of the sum of a table's frequencies
const TOTAL = 1 << PRECISION;
const LOWEST = 1 << 23; // rANS states are from here to below 256 times as much
const FINE = 2; // bits of a token after the leading one
const MOST_DIRECT = 8;
const MOST_BITS = 52; // of a magnitude
const MOST_THRESHOLDS = 7;
const ORDERS = 3; // kinds of contexts
const LEVEL_BOUNDS = [3, 7, 13, 21, 32, 56, 96]; // of 16 times the running mean of magnitudes
const MOST_MAGNITUDE = 255; // in a running mean
// Context by 16 times a running mean.
const LEVELS = Uint8Array.from({ length: 16 * MOST_MAGNITUDE + 16 }, (_, mean) => {
  return 1 + LEVEL_BOUNDS.filter((bound) => mean >= bound).length;
});
const MOST_OTHERS = 2; // largest sum of the magnitudes of a row's earlier numbers

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

// Reads the tables of all contexts. By slot, TOTAL per context: its token, and TOTAL times the token's frequency plus the
// slot's index among the token's; 0 in a context without table.
function readTables(bytes: Bytes, contexts: number, most: number) {
  const [tokens, steps] = [new Uint16Array(contexts * TOTAL), new Int32Array(contexts * TOTAL)];
  for (let context = 0, first = 0; context < contexts; context++, first = context * TOTAL) {
    const end = first + TOTAL;
    const count = bytes.number(most);
    for (let token = 0; token < count; token++) {
      const frequency = bytes.number(TOTAL);
      const zeros = frequency ? 0 : bytes.number(most);
      if (first + frequency > end || token + zeros >= count) throw new Error('a table is too long');
      tokens.fill(token, first, first + frequency);
      for (let k = 0; k < frequency; k++) steps[first + k] = frequency * TOTAL + k;
      first += frequency;
      token += zeros;
    }
    if (count && first !== end) throw new Error('a table is incomplete');
  }
  return { tokens, steps };
}

// Decodes a number of every row of a column into `codes`. blocks: number of blocks whose coefficients the rows are;
// 0 = plain rows. sums: by row, the magnitudes of its earlier numbers, at most 2 in all, to which these are added; null
// = not needed. number: index in a row.
function decodeIntegers(
  data: Uint8Array,
  codes: Float64Array | Int32Array,
  blocks: number,
  sums: Uint8Array | null,
  number: number,
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
  if (order === 2 && blocks && !(sums && number)) throw new Error('its head is of no kind');
  const thresholds: number[] = [];
  if (order && !blocks) {
    for (let k = bytes.number(MOST_THRESHOLDS); k; k--) thresholds.push(bytes.signed());
    if (thresholds.some((x, k) => k && x < thresholds[k - 1])) throw new Error('its thresholds do not ascend');
  }
  const inBlocks = (LEVEL_BOUNDS.length + 2) * (order === 2 ? MOST_OTHERS + 1 : 1);
  const contexts = !order ? 1 : blocks ? inBlocks : thresholds.length + 1;
  const most = 2 * (2 ** direct + (MOST_BITS - direct) * 2 ** FINE) - 1;
  const { tokens, steps } = readTables(bytes, contexts, most);
  const coded = bytes.rest(bytes.number(data.length));
  if (coded.length < 4) throw new Error('it ends early');
  let state = coded.subarray(0, 4).reduce((sum, byte) => sum * 256 + byte, 0);
  if (state < LOWEST || state >= LOWEST * 256) throw new Error('its state is out of range');
  const plain = bytes.rest(bytes.left);
  let [at, next] = [4, 0]; // bytes of `coded` and `plain` that are read
  let [held, count] = [0, 0]; // plain bits that are read, and not used
  const means = new Int32Array(order ? blocks : 0);
  let [before, earlier, block] = [0, 0, 0];
  const inOrder = order > 0 && blocks > 0;
  for (let i = 0; i < rows; i++) {
    let context = 0;
    if (inOrder) {
      if (i >= blocks) context = LEVELS[means[block]];
      if (order === 2) context = (MOST_OTHERS + 1) * context + sums![i];
    } else if (order) {
      const sum = before + (order === 2 ? earlier : 0);
      while (context < thresholds.length && thresholds[context] < sum) context++;
    }
    const slot = context * TOTAL + (state & (TOTAL - 1));
    const token = tokens[slot];
    const step = steps[slot];
    if (!step) throw new Error('a table is missing');
    state = Math.imul(step >> PRECISION, state >> PRECISION) + (step & (TOTAL - 1));
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
    if (sums && magnitude) sums[i] = Math.min(MOST_OTHERS, sums[i] + Math.min(MOST_OTHERS, magnitude));
    if (inOrder) {
      means[block] += 4 * Math.min(MOST_MAGNITUDE, magnitude) - (means[block] >> 2);
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

export interface Column {
  name: string;
  step: number | null;
  bytes: number[]; // of each number
}

export type Codes = Float64Array | Int32Array;

const bytesOf = ({ bytes }: Column): number => bytes.reduce((sum, size) => sum + size, 0);

// Checks that the columns are those expected ([name, numbers per row]) and fill the file.
export function checkColumns(columns: Column[], expected: [string, number][], size: number, file: string): void {
  const names = (list: string[]): string => list.join(', ') || 'none';
  const listed = names(columns.map((column) => column.name));
  if (listed !== names(expected.map(([name]) => name))) throw new DamagedBundle(`${file}: its columns are ${listed}.`);
  columns.forEach((column, k) => {
    const [name, numbers] = expected[k];
    if (column.bytes.length !== numbers) {
      throw new DamagedBundle(`${file}: the column ${name} needs ${numbers} numbers.`);
    }
  });
  const stated = columns.reduce((sum, column) => sum + bytesOf(column), 0);
  if (stated !== size) throw new DamagedBundle(`${file} has ${size} bytes, its columns need ${stated}.`);
}

export class ColumnReader {
  private at = 0;
  private next = 0;

  constructor(
    private readonly data: Uint8Array,
    private readonly columns: Column[],
    private readonly file: string,
  ) {}

  get name(): string | undefined {
    return this.columns[this.next]?.name;
  }

  // Reads the next column: `rows` codes per number.
  read<T extends Codes>(rows: number, make: (rows: number) => T, blocks = 0): T[] {
    const { bytes } = this.columns[this.next++];
    const sums = blocks && bytes.length > 1 ? new Uint8Array(rows) : null;
    return bytes.map((size, number) => this.decode(size, make(rows), blocks, sums, number));
  }

  private decode<T extends Codes>(size: number, codes: T, blocks: number, sums: Uint8Array | null, number: number): T {
    try {
      decodeIntegers(this.data.subarray(this.at, this.at + size), codes, blocks, sums, number);
    } catch (error) {
      throw new DamagedBundle(`${this.file}: a column is damaged: ${messageOf(error)}.`);
    }
    this.at += size;
    return codes;
  }
}
