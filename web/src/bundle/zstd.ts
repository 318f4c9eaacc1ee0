// Zstandard frames of a stated size, decoded by fzstd. It trusts the sizes in a frame and never ends on one kind of
// table; both are checked here, so that a damaged frame is an error.
import { decompress } from 'fzstd';
import { DamagedBundle } from '../errors';

const MAGIC = 0xfd2fb528;
const MOST_IN_BLOCK = 1 << 17; // bytes of a decoded block
const MOST_ACCURACY = 6; // bits of the probabilities of a Huffman table's weights
const SHORTEST_MATCH = 3; // bytes, which bounds the sequences of a block

class Bytes {
  constructor(
    private readonly data: Uint8Array,
    public at: number,
    private readonly end: number,
  ) {}
  // Reads a little-endian number of `count` bytes.
  number(count: number): number {
    if (this.at + count > this.end) throw new Error('it ends early');
    let value = 0;
    for (let i = 0; i < count; i++) value += this.data[this.at++] * 2 ** (8 * i);
    return value;
  }
  skip(count: number): void {
    this.at += count;
    if (this.at > this.end) throw new Error('it ends early');
  }
}

// Reads `count` bits from bit `at`, lowest first; 0 beyond the end.
const bits = (data: Uint8Array, at: number, count: number): number => {
  const byte = (k: number): number => data[(at >> 3) + k] ?? 0;
  return ((byte(0) | (byte(1) << 8) | (byte(2) << 16)) >> (at & 7)) & ((1 << count) - 1);
};

// Returns true if the table of probabilities at byte `at` has a single symbol. Its states take no bits, so decoding
// until the bits are used up never ends; encoders do not write such tables.
function oneSymbol(data: Uint8Array, at: number): boolean {
  const accuracy = bits(data, 8 * at, 4) + 5;
  if (accuracy > MOST_ACCURACY) return false; // refused elsewhere
  let place = 8 * at + 4;
  for (let symbol = 0; symbol < 256;) {
    if (bits(data, place, accuracy + 1) === 2 ** (accuracy + 1) - 1) return true;
    if (bits(data, place, accuracy) !== 1) return false; // not the probability 0
    place += accuracy;
    let more: number;
    do {
      more = bits(data, place, 2);
      place += 2;
      symbol += more;
    } while (more === 3 && symbol < 256);
    symbol++;
  }
  return false;
}

// Returns the least and most bytes that a block of literals and sequences can decode to.
function heldBy(data: Uint8Array, begin: number, size: number): [number, number] {
  const bytes = new Bytes(data, begin, begin + size);
  const first = data[begin];
  const [type, format] = [first & 3, (first >> 2) & 3];
  let literals: number;
  if (type < 2) {
    const header = bytes.number(format & 1 ? (format & 2 ? 3 : 2) : 1);
    literals = header >> (format & 1 ? 4 : 3);
    bytes.skip(type === 0 ? literals : 1);
  } else {
    const width = format < 2 ? 10 : format === 2 ? 14 : 18;
    const header = bytes.number((4 + 2 * width) >> 3);
    literals = Math.floor(header / 16) % 2 ** width;
    const packed = Math.floor(header / 2 ** (4 + width));
    if (type === 2 && data[bytes.at] < 128 && oneSymbol(data, bytes.at + 1)) throw new Error('a table says nothing');
    bytes.skip(packed);
  }
  const head = bytes.number(1);
  let sequences = head;
  if (head === 255) sequences = bytes.number(2) + 0x7f00;
  else if (head > 127) sequences = (head - 128) * 256 + bytes.number(1);
  const least = literals + SHORTEST_MATCH * sequences;
  if (least > MOST_IN_BLOCK) throw new Error('a block holds too much');
  return [least, sequences ? MOST_IN_BLOCK : literals];
}

// Returns the decoded size that a frame declares. Throws if there is none, or its blocks cannot have it.
function declared(frame: Uint8Array): number {
  const bytes = new Bytes(frame, 0, frame.length);
  if (bytes.number(4) !== MAGIC) throw new Error('it is no frame');
  const flags = bytes.number(1);
  const single = (flags >> 5) & 1;
  if (flags & 0b1011) throw new Error('it needs what is not there'); // reserved, dictionary
  if (!single) bytes.skip(1);
  const width = [single, 2, 4, 8][flags >> 6];
  if (!width) throw new Error('it does not declare its size');
  const size = bytes.number(width) + (width === 2 ? 256 : 0);
  let [least, most] = [0, 0]; // bytes that the blocks hold
  for (let last = 0; !last;) {
    const head = bytes.number(3);
    last = head & 1;
    const [type, held] = [(head >> 1) & 3, head >> 3];
    if (type === 3 || held > MOST_IN_BLOCK) throw new Error('a block is of no kind');
    const [low, high] = type === 2 ? heldBy(frame, bytes.at, held) : [held, held];
    least += low;
    most += high;
    bytes.skip(type === 1 ? 1 : held);
  }
  bytes.skip(flags & 4);
  if (bytes.at !== frame.length) throw new Error('something follows it');
  if (size < least || size > most) throw new Error(`its blocks do not hold the ${size} bytes that it declares`);
  return size;
}

// Decodes a frame of exactly `size` bytes; its header is checked before allocating.
export function frameBytes(frame: Uint8Array, size: number, name: string): Uint8Array {
  try {
    const found = declared(frame);
    if (found !== size) throw new Error(`it declares ${found} bytes, ${size} are wanted`);
    if (size === 0) return new Uint8Array();
    // fzstd allocates: it would convert a buffer passed to it to a string, for a comparison with a number
    const data = decompress(frame);
    if (data.length !== size) throw new Error(`it holds ${data.length} bytes, ${size} are wanted`);
    return data;
  } catch (error) {
    const why = error instanceof Error ? error.message : String(error);
    throw new DamagedBundle(`${name}: a Zstandard frame is damaged: ${why}.`);
  }
}
