// Decodes texels.bin, the cosine transforms of the tiles (docs/baking.md), to byte pages.
import { DamagedBundle } from '../../errors';
import type { Pages } from '../ktx2';
import type { Atlas, CodedTexels } from '../manifest';
import { type Surfels, alphaIn, layerIn } from '../surfels';
import { GRADES, MOST_COEFFICIENT, SPARE_TEXELS, SURFEL_WORDS, TEXELS_PER_BYTE, WORD } from '../tables';
import { ColumnReader, checkColumns } from './columns';

const MOST_TEXELS = 2 ** 30; // in all pages: four gigabytes
const BLOCK = 8;
const FILE = 'texels.bin';

function tilesOf(surfels: Surfels) {
  const numbers = numbersOf(surfels);
  const tiles = [];
  for (let surfel = 0; surfel < surfels.count; surfel++) {
    const sides = numbers[surfel * SURFEL_WORDS + WORD.sides];
    if (sides) tiles.push({ surfel, u: sides & 0xffff, v: sides >>> 16 });
  }
  return tiles;
}
type Tile = ReturnType<typeof tilesOf>[number];

const numbersOf = ({ words }: Surfels): Uint32Array => new Uint32Array(words.buffer, words.byteOffset, words.length);

// Returns C(k, i, count) for all frequencies k and positions i.
const cosines = (count: number): Float64Array =>
  Float64Array.from({ length: count * count }, (_, at) => {
    const [k, i] = [Math.floor(at / count), at % count];
    return Math.sqrt((k ? 2 : 1) / count) * Math.cos((Math.PI * (i + 0.5) * k) / count);
  });

// Returns the inverse cosine transform of blocks of u x v texels: `across` [u, u] and `down` [v, v], frequency by
// position; by coefficient in stored order the offset of its frequency along v in `half`, and along u in `across`.
function transformOf(u: number, v: number) {
  const order: [number, number][] = [];
  for (let k_v = 0; k_v < v; k_v++) for (let k_u = 0; k_u < u; k_u++) order.push([k_v, k_u]);
  order.sort((a, b) => a[0] * u + a[1] * v - (b[0] * u + b[1] * v) || a[0] - b[0] || a[1] - b[1]);
  const [row, wave] = [0, 1].map((axis) => Int32Array.from(order, (k) => k[axis] * u));
  return { u, v, across: cosines(u), down: cosines(v), row, wave };
}
type Transform = ReturnType<typeof transformOf>;

const half = new Float64Array(BLOCK * BLOCK); // scratch of `inverse`: a block transformed along u

// Computes a channel of a block's texels from every `stride`-th number from `first` on. Sides are multiples of four.
function inverse(values: Int32Array, first: number, stride: number, transform: Transform, texels: Float64Array): void {
  const { u, v, across, down, row, wave } = transform;
  const count = u * v;
  half.fill(0);
  for (let f = 0, from = first; f < count; f++, from += stride) {
    const value = values[from];
    if (value === 0) continue;
    const end = wave[f] + u;
    for (let to = row[f], by = wave[f]; by < end; to += 4, by += 4) {
      half[to] += value * across[by];
      half[to + 1] += value * across[by + 1];
      half[to + 2] += value * across[by + 2];
      half[to + 3] += value * across[by + 3];
    }
  }
  for (let t = 0, at = 0; t < count; t += u, at++) {
    for (let i = 0; i < u; i += 4) {
      let [a, b, c, d] = [0, 0, 0, 0];
      for (let from = i, by = at; from < count; from += u, by += v) {
        const weight = down[by];
        a += weight * half[from];
        b += weight * half[from + 1];
        c += weight * half[from + 2];
        d += weight * half[from + 3];
      }
      texels[t + i] = a;
      texels[t + i + 1] = b;
      texels[t + i + 2] = c;
      texels[t + i + 3] = d;
    }
  }
}

// Blocks of one size.
interface Blocks {
  u: number;
  v: number;
  texels: number; // in all of them
}

const byteOf = (x: number): number => (x > 0 ? (x < 255 ? (x + 0.5) | 0 : 255) : 0);

class Painter {
  private readonly pages: Uint32Array; // concatenated
  private readonly numbers: Uint32Array;
  private readonly offset: number;
  private readonly perByte: number;
  private readonly sums = [0, 1, 2].map(() => new Float64Array(BLOCK * BLOCK));

  constructor(
    private readonly atlas: Atlas,
    private readonly surfels: Surfels,
    private readonly tiles: Tile[],
  ) {
    const { width, height, layers } = atlas;
    this.offset = atlas.offset;
    this.perByte = 255 / atlas.scale;
    const empty = this.code(0, 0, 0) & (atlas.alphaScale ? 0xffffff : -1);
    this.pages = new Uint32Array(width * height * layers).fill(empty);
    this.numbers = numbersOf(surfels);
  }

  private byte(residual: number): number {
    return byteOf((residual - this.offset) * this.perByte);
  }
  // Encodes a residual colour as an opaque texel.
  private code(r: number, g: number, b: number): number {
    return (this.byte(r) | (this.byte(g) << 8) | (this.byte(b) << 16) | (255 << 24)) >>> 0;
  }

  // Visits blocks of one size: index of the tile, row of its surfel, block, first texel.
  private each({ u, v }: Blocks, visit: (tile: number, row: number, block: number, first: number) => void): void {
    const { width, height } = this.atlas;
    let block = 0;
    this.tiles.forEach((tile, number) => {
      if (Math.min(tile.u, BLOCK) !== u || Math.min(tile.v, BLOCK) !== v) return;
      const row = tile.surfel * SURFEL_WORDS;
      const line = layerIn(this.numbers[row + WORD.layer]) * height + this.numbers[row + WORD.tile + 1];
      const first = line * width + this.numbers[row + WORD.tile];
      for (let at_v = 0; at_v < tile.v; at_v += v) {
        for (let at_u = 0; at_u < tile.u; at_u += u) visit(number, row, block++, first + at_v * width + at_u);
      }
    });
  }

  // Returns where a block's texels lie, from its first on.
  private offsets({ u, v }: Blocks): Int32Array {
    return Int32Array.from({ length: u * v }, (_, t) => Math.floor(t / u) * this.atlas.width + (t % u));
  }

  // Writes the residual colours of blocks from coefficients [channel][frequency * blocks + block].
  colors(blocks: Blocks, coefficients: Int32Array[], steps: Float64Array): void {
    const { u, v } = blocks;
    const [transform, offsets] = [transformOf(u, v), this.offsets(blocks)];
    const [p0, p1, p2] = this.sums;
    const [c0, c1, c2] = coefficients;
    const [count, words] = [blocks.texels / (u * v), this.surfels.words];
    const [toGrey, toTilt, toBend] = [3, 2, 6].map((squares) => 1 / Math.sqrt(squares));
    this.each(blocks, (tile, row, block, first) => {
      const red = words[row + WORD.residual];
      const green = words[row + WORD.residual + 1];
      const blue = words[row + WORD.residual + 2];
      const step = steps[tile];
      inverse(c0, block, count, transform, p0);
      inverse(c1, block, count, transform, p1);
      inverse(c2, block, count, transform, p2);
      for (let t = 0; t < offsets.length; t++) {
        const grey = step * toGrey * p0[t];
        const tilt = step * toTilt * p1[t];
        const bend = step * toBend * p2[t];
        this.pages[first + offsets[t]] = this.code(
          red + grey + tilt + bend,
          green + grey - 2 * bend,
          blue + grey - tilt + bend,
        );
      }
    });
  }

  // Writes the alphas of blocks, after their colours.
  alphas(blocks: Blocks, [coefficients]: Int32Array[], steps: Float64Array): void {
    const { u, v } = blocks;
    const [transform, offsets] = [transformOf(u, v), this.offsets(blocks)];
    const [sums] = this.sums;
    const perByte = 255 / this.atlas.alphaScale;
    this.each(blocks, (tile, row, block, first) => {
      const mean = alphaIn(this.numbers[row + WORD.layer]);
      inverse(coefficients, block, blocks.texels / (u * v), transform, sums);
      for (let t = 0; t < u * v; t++) {
        const to = first + offsets[t];
        const byte = byteOf((mean + steps[tile] * sums[t]) * perByte);
        this.pages[to] = (this.pages[to] & 0xffffff) | (byte << 24);
      }
    });
  }

  // Each in its own buffer.
  layers(): Uint8Array[] {
    const size = this.atlas.width * this.atlas.height;
    return Array.from({ length: this.atlas.layers }, (_, k) => {
      return new Uint8Array(this.pages.slice(k * size, (k + 1) * size).buffer);
    });
  }
}

function tooLarge(values: Int32Array): boolean {
  for (let i = 0; i < values.length; i++)
    if (values[i] > MOST_COEFFICIENT || values[i] < -MOST_COEFFICIENT) return true;
  return false;
}

function check(data: Uint8Array, atlas: Atlas, coded: CodedTexels, found: number): void {
  const texels = atlas.width * atlas.height * atlas.layers;
  const most = TEXELS_PER_BYTE * (data.length + coded.surfelBytes) + SPARE_TEXELS;
  if (Math.max(coded.texels, texels) > most || texels > MOST_TEXELS) {
    throw new DamagedBundle(`${FILE}: ${texels} texels cannot be in ${data.length} bytes.`);
  }
  if (found !== coded.texels) {
    throw new DamagedBundle(
      `${FILE}: the tiles of the surfels have ${found} texels, bundle.json says ${coded.texels}.`,
    );
  }
}

export function readCompactTexels(data: Uint8Array, atlas: Atlas, surfels: Surfels): Pages {
  const coded = atlas.coded!;
  const tiles = tilesOf(surfels);
  const held = new Map<string, Blocks>();
  for (const tile of tiles) {
    const [u, v] = [Math.min(tile.u, BLOCK), Math.min(tile.v, BLOCK)];
    const blocks = held.get(`${u}x${v}`) ?? { u, v, texels: 0 };
    blocks.texels += tile.u * tile.v;
    held.set(`${u}x${v}`, blocks);
  }
  check(
    data,
    atlas,
    coded,
    [...held.values()].reduce((sum, { texels }) => sum + texels, 0),
  );
  const names = [...held.keys()].sort();
  const colors = names.map((name): [string, number] => [name, 3]);
  const alphas = names.map((name): [string, number] => [`alpha_${name}`, 1]);
  checkColumns(coded.columns, [['grade', 1], ...colors, ...(atlas.alphaScale ? alphas : [])], data.length, FILE);
  const reader = new ColumnReader(data, coded.columns, FILE);
  const [grades] = reader.read(tiles.length, (rows) => new Float64Array(rows));
  if (grades.some((grade) => !(grade >= GRADES[0] && grade <= GRADES[1]))) {
    throw new DamagedBundle(`${FILE}: a grade is not from ${GRADES.join(' to ')}.`);
  }
  const painter = new Painter(atlas, surfels, tiles);
  const stepsOf = (step: number): Float64Array => grades.map((grade) => step * 2 ** (grade / 2));
  for (const { name, step } of coded.columns.slice(1)) {
    const isAlpha = name.startsWith('alpha_');
    if (isAlpha && step === null) throw new DamagedBundle(`${FILE}: ${name} has no step.`);
    const blocks = held.get(name.replace('alpha_', ''))!;
    const coefficients = reader.read(
      blocks.texels,
      (rows) => new Int32Array(rows),
      blocks.texels / (blocks.u * blocks.v),
    );
    if (coefficients.some(tooLarge)) {
      throw new DamagedBundle(`${FILE}: a coefficient of ${name} is beyond ${MOST_COEFFICIENT}.`);
    }
    if (isAlpha) painter.alphas(blocks, coefficients, stepsOf(step!));
    else painter.colors(blocks, coefficients, stepsOf(coded.step));
  }
  return { format: 'uint8', width: atlas.width, height: atlas.height, layers: painter.layers() };
}
