// Decodes BC7 blocks to RGBA texels, for adapters without BC7 textures. Tables are those of the Khronos Data Format
// Specification.

interface Mode {
  subsets: number;
  partition: number; // bits
  rotation: number;
  selector: number;
  color: number;
  alpha: number;
  shared: 'none' | 'endpoint' | 'subset'; // P bits: none, one per endpoint or one per subset
  index: number;
  index2: number;
}
const PLAIN = { partition: 0, rotation: 0, selector: 0, alpha: 0, index2: 0 };
const MODES: Mode[] = [
  { ...PLAIN, subsets: 3, partition: 4, color: 4, shared: 'endpoint', index: 3 },
  { ...PLAIN, subsets: 2, partition: 6, color: 6, shared: 'subset', index: 3 },
  { ...PLAIN, subsets: 3, partition: 6, color: 5, shared: 'none', index: 2 },
  { ...PLAIN, subsets: 2, partition: 6, color: 7, shared: 'endpoint', index: 2 },
  { ...PLAIN, subsets: 1, rotation: 2, selector: 1, color: 5, alpha: 6, shared: 'none', index: 2, index2: 3 },
  { ...PLAIN, subsets: 1, rotation: 2, color: 7, alpha: 8, shared: 'none', index: 2, index2: 2 },
  { ...PLAIN, subsets: 1, color: 7, alpha: 7, shared: 'endpoint', index: 4 },
  { ...PLAIN, subsets: 2, partition: 6, color: 5, alpha: 5, shared: 'endpoint', index: 2 },
];
const WEIGHTS: Record<number, number[]> = {
  2: [0, 21, 43, 64],
  3: [0, 9, 18, 27, 37, 46, 55, 64],
  4: [0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64],
};
// Per partition: each texel's subset, in one or two bits; anchor texels, whose highest index bit is 0 and not stored.
const TWO = [
  0xcccc, 0x8888, 0xeeee, 0xecc8, 0xc880, 0xfeec, 0xfec8, 0xec80, 0xc800, 0xffec, 0xfe80, 0xe800, 0xffe8, 0xff00,
  0xfff0, 0xf000, 0xf710, 0x8e, 0x7100, 0x8ce, 0x8c, 0x7310, 0x3100, 0x8cce, 0x88c, 0x3110, 0x6666, 0x366c, 0x17e8,
  0xff0, 0x718e, 0x399c, 0xaaaa, 0xf0f0, 0x5a5a, 0x33cc, 0x3c3c, 0x55aa, 0x9696, 0xa55a, 0x73ce, 0x13c8, 0x324c, 0x3bdc,
  0x6996, 0xc33c, 0x9966, 0x660, 0x272, 0x4e4, 0x4e40, 0x2720, 0xc936, 0x936c, 0x39c6, 0x639c, 0x9336, 0x9cc6, 0x817e,
  0xe718, 0xccf0, 0xfcc, 0x7744, 0xee22,
];
const THREE = [
  0xaa685050, 0x6a5a5040, 0x5a5a4200, 0x5450a0a8, 0xa5a50000, 0xa0a05050, 0x5555a0a0, 0x5a5a5050, 0xaa550000,
  0xaa555500, 0xaaaa5500, 0x90909090, 0x94949494, 0xa4a4a4a4, 0xa9a59450, 0x2a0a4250, 0xa5945040, 0xa425054, 0xa5a5a500,
  0x55a0a0a0, 0xa8a85454, 0x6a6a4040, 0xa4a45000, 0x1a1a0500, 0x50a4a4, 0xaaa59090, 0x14696914, 0x69691400, 0xa08585a0,
  0xaa821414, 0x50a4a450, 0x6a5a0200, 0xa9a58000, 0x5090a0a8, 0xa8a09050, 0x24242424, 0xaa5500, 0x24924924, 0x24499224,
  0x50a50a50, 0x500aa550, 0xaaaa4444, 0x66660000, 0xa5a0a5a0, 0x50a050a0, 0x69286928, 0x44aaaa44, 0x66666600,
  0xaa444444, 0x54a854a8, 0x95809580, 0x96969600, 0xa85454a8, 0x80959580, 0xaa141414, 0x96960000, 0xaaaa1414,
  0xa05050a0, 0xa0a5a5a0, 0x96000000, 0x40804080, 0xa9a8a9a8, 0xaaaaaa44, 0x2a4a5254,
];
const ANCHOR_TWO = [
  15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 2, 8, 2, 2, 8, 8, 15, 2, 8, 2, 2, 8, 8, 2, 2, 15,
  15, 6, 8, 2, 8, 15, 15, 2, 8, 2, 2, 2, 15, 15, 6, 6, 2, 6, 8, 15, 15, 2, 2, 15, 15, 15, 15, 15, 2, 2, 15,
];
const ANCHOR_SECOND = [
  3, 3, 15, 15, 8, 3, 15, 15, 8, 8, 6, 6, 6, 5, 3, 3, 3, 3, 8, 15, 3, 3, 6, 10, 5, 8, 8, 6, 8, 5, 15, 15, 8, 15, 3, 5,
  6, 10, 8, 15, 15, 3, 15, 5, 15, 15, 15, 15, 3, 15, 5, 5, 5, 8, 5, 10, 5, 10, 8, 13, 15, 12, 3, 3,
];
const ANCHOR_THIRD = [
  15, 8, 8, 3, 15, 15, 3, 8, 15, 15, 15, 15, 15, 15, 15, 8, 15, 8, 15, 3, 15, 8, 15, 8, 3, 15, 6, 10, 15, 15, 10, 8, 15,
  3, 15, 10, 10, 8, 9, 10, 6, 15, 8, 15, 3, 6, 6, 8, 15, 3, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 3, 15, 15, 8,
];

class Bits {
  private at = 0;
  constructor(
    private readonly data: Uint8Array,
    private readonly start: number,
  ) {}
  take(count: number): number {
    let value = 0;
    for (let i = 0; i < count; i++, this.at++) {
      value |= ((this.data[this.start + (this.at >> 3)] >> (this.at & 7)) & 1) << i;
    }
    return value;
  }
}

const subsetOf = (subsets: number, partition: number, texel: number): number => {
  if (subsets === 2) return (TWO[partition] >>> texel) & 1;
  return subsets === 3 ? (THREE[partition] >>> (2 * texel)) & 3 : 0;
};
const isAnchor = (subsets: number, partition: number, texel: number): boolean => {
  if (texel === 0) return true;
  if (subsets === 2) return texel === ANCHOR_TWO[partition];
  return subsets === 3 && (texel === ANCHOR_SECOND[partition] || texel === ANCHOR_THIRD[partition]);
};
const widen = (value: number, bits: number): number => {
  const top = value << (8 - bits);
  return top | (top >> bits);
};
const mix = (a: number, b: number, weight: number): number => ((64 - weight) * a + weight * b + 32) >> 6;

// Reads endpoints [subset][end][channel], 8 bits each.
function endpoints(bits: Bits, m: Mode): number[][][] {
  const ends = Array.from({ length: m.subsets }, () => [
    [0, 0, 0, 255],
    [0, 0, 0, 255],
  ]);
  const channels = m.alpha ? 4 : 3;
  for (let c = 0; c < channels; c++) {
    for (const pair of ends) for (const end of pair) end[c] = bits.take(c < 3 ? m.color : m.alpha);
  }
  const extra = m.shared === 'none' ? 0 : 1;
  for (const pair of ends) {
    const common = m.shared === 'subset' ? bits.take(1) : 0;
    for (const end of pair) {
      const low = m.shared === 'endpoint' ? bits.take(1) : common;
      for (let c = 0; c < channels; c++) {
        const stored = c < 3 ? m.color : m.alpha;
        end[c] = widen(extra ? (end[c] << 1) | low : end[c], stored + extra);
      }
    }
  }
  return ends;
}

function decodeBlock(data: Uint8Array, start: number, out: Uint8Array, to: number, row: number): void {
  const bits = new Bits(data, start);
  let number = 0;
  while (number < 8 && !bits.take(1)) number++;
  const m = MODES[number];
  if (!m) {
    for (let y = 0; y < 4; y++) out.fill(0, to + y * row, to + y * row + 16);
    return;
  }
  const partition = bits.take(m.partition);
  const rotation = bits.take(m.rotation);
  const selector = bits.take(m.selector);
  const ends = endpoints(bits, m);
  const read = (width: number): number[] =>
    Array.from({ length: 16 }, (_, texel) => bits.take(width - (isAnchor(m.subsets, partition, texel) ? 1 : 0)));
  const first = read(m.index);
  const second = m.index2 ? read(m.index2) : first;
  const [color, alpha] = selector ? [second, first] : [first, second];
  const colorWeights = WEIGHTS[selector ? m.index2 : m.index];
  const alphaWeights = WEIGHTS[m.index2 && !selector ? m.index2 : m.index];
  for (let texel = 0; texel < 16; texel++) {
    const [a, b] = ends[subsetOf(m.subsets, partition, texel)];
    const at = to + (texel >> 2) * row + (texel & 3) * 4;
    for (let c = 0; c < 3; c++) out[at + c] = mix(a[c], b[c], colorWeights[color[texel]]);
    out[at + 3] = mix(a[3], b[3], alphaWeights[alpha[texel]]);
    if (rotation) {
      const swapped = out[at + rotation - 1];
      out[at + rotation - 1] = out[at + 3];
      out[at + 3] = swapped;
    }
  }
}

// Decodes a page of width x height texels, both multiples of 4.
export function decodeBc7(blocks: Uint8Array, width: number, height: number): Uint8Array<ArrayBuffer> {
  const out = new Uint8Array(width * height * 4);
  const row = width * 4;
  for (let y = 0, at = 0; y < height; y += 4) {
    for (let x = 0; x < width; x += 4, at += 16) decodeBlock(blocks, at, out, y * row + x * 4, row);
  }
  return out;
}
