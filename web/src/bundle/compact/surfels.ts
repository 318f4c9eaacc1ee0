// Decodes surfels.bin: docs/baking.md describes its columns, codec/surfel_codes.py writes them.
import { DamagedBundle } from '../../errors';
import type { CompactSurfels, Manifest } from '../manifest';
import { type Surfels, alphaWord, centred, originOf, setTerms, setTile } from '../surfels';
import {
  COLOR_LIMIT,
  COLUMNS,
  EXTENT,
  EXTENTS,
  KINDS,
  LATER,
  REDUCED_COUNTS,
  REDUCED_WIDTH,
  LIMITS,
  LINEAR,
  MAX_TERMS,
} from '../tables';
import { MOST_EXPONENT, POSITION_BITS, SHAPES, SMALLEST_SHARE, SPARE_SURFELS, STEPPED } from '../tables';
import { SURFELS_PER_BYTE, SURFEL_WORDS, WORD } from '../tables';
import { ColumnReader, checkColumns } from './columns';
import { pack } from './packing';

const LEAST_EXPONENT = 2; // log2 of a tile side
const BENT = 50; // largest argument of sinh: beyond all limits
const FILE = 'surfels.bin';

const clip = (x: number, low: number, high: number): number => Math.min(Math.max(x, low), high);
const within = (x: number, limit: number): number => clip(x, -limit, limit);
const logit = (share: number, least: number): number => {
  const x = clip(share, least, 1 - SMALLEST_SHARE);
  return Math.log(x) - Math.log1p(-x);
};
const sinh = (x: number): number => Math.sinh(within(x, BENT));

function expected({ viewColor: kind, atlas, compact }: Manifest): [string, number][] {
  const stated = new Set(compact!.columns.map((column) => column.name));
  const lacking = (name: string): boolean =>
    name === 'alpha' ? !atlas?.alphaScale : !stated.has(name) && LATER.includes(name);
  const shapes = SHAPES[kind].limits.length;
  const terms: [string, number][] = [
    ['term_shape', shapes],
    ['term_color', REDUCED_WIDTH[kind] - shapes],
  ];
  return [...Object.entries(COLUMNS).filter(([name]) => !lacking(name)), ...terms];
}

// Extracts every third bit of a number below 2^27, from the lowest.
function thirds(key: number): number {
  let cell = 0;
  for (let i = 0; i < 9; i++) cell |= ((key >> (3 * i)) & 1) << i;
  return cell;
}

// Writes a colour from row i of the columns green, red - green and blue - green, the first at `at`.
function color(to: Float32Array, first: number, of: Float64Array[], at: number, i: number, step: number): void {
  const green = of[at][i];
  to[first] = within(step * (of[at + 1][i] + green), COLOR_LIMIT);
  to[first + 1] = within(step * green, COLOR_LIMIT);
  to[first + 2] = within(step * (of[at + 2][i] + green), COLOR_LIMIT);
}

class Decoder {
  private readonly words: Float32Array;
  private readonly numbers: Uint32Array;
  private readonly codes = new Map<string, Float64Array[]>();
  private readonly count: number;
  private readonly terms: number;
  private readonly stated: CompactSurfels;
  private readonly alpha: boolean;

  constructor(
    data: Uint8Array,
    private readonly info: Manifest,
  ) {
    this.stated = info.compact!;
    this.count = info.count;
    this.terms = info.terms ?? 0;
    this.alpha = Boolean(info.atlas?.alphaScale);
    const columns = this.stated.columns;
    checkColumns(columns, expected(info), data.length, FILE);
    if (Math.max(this.count, this.terms) > SURFELS_PER_BYTE * data.length + SPARE_SURFELS) {
      throw new DamagedBundle(`${FILE}: ${this.count} surfels cannot be in ${data.length} bytes.`);
    }
    for (const { name, step } of columns) {
      if (step === null && STEPPED.includes(name)) this.refuse(`${name} has no step`);
    }
    const reader = new ColumnReader(data, columns, FILE);
    for (let name = reader.name; name !== undefined; name = reader.name) {
      this.codes.set(
        name,
        reader.read(this.rowsOf(name), (rows) => new Float64Array(rows)),
      );
    }
    this.words = new Float32Array(this.count * SURFEL_WORDS);
    this.numbers = new Uint32Array(this.words.buffer);
  }

  private refuse(why: string): never {
    throw new DamagedBundle(`${FILE}: ${why}.`);
  }
  private column(name: string): Float64Array[] {
    return this.codes.get(name)!;
  }
  private step(name: string): number {
    return this.stated.columns.find((column) => column.name === name)?.step ?? 0;
  }
  private rowsOf(name: string): number {
    if (name === 'extent') return this.column('size')[0].reduce((sum, size) => sum + (size > 0 ? 1 : 0), 0);
    return name.startsWith('term_') ? this.terms : this.count;
  }

  private positions(): void {
    const { center, scale, low } = this.stated.frame;
    const [differences, step] = [this.column('place')[0], this.step('place')];
    let key = 0;
    for (let i = 0, to = WORD.mean; i < this.count; i++, to += SURFEL_WORDS) {
      key += differences[i];
      if (differences[i] < 0 || key >= 2 ** (3 * POSITION_BITS))
        this.refuse('positions do not ascend, or leave their grid');
      const [lower, upper] = [key % 2 ** 24, Math.floor(key / 2 ** 24)];
      for (let a = 0; a < 3; a++) {
        const cell = (thirds(lower >> a) & 0xff) | (thirds(upper >> a) << 8);
        this.words[to + a] = within(center[a] + scale * sinh(low[a] + step * cell), LIMITS.means[2]);
      }
    }
  }

  private rotations(): void {
    const [largest, rest, step] = [this.column('largest')[0], this.column('rotation'), this.step('rotation')];
    const quat = [0, 0, 0, 0];
    for (let i = 0, to = WORD.quat; i < this.count; i++, to += SURFEL_WORDS) {
      if (!(largest[i] >= 0 && largest[i] <= 3)) this.refuse("a rotation's largest number is not one of four");
      let squares = 0;
      for (let k = 0, from = 0; k < 4; k++) {
        if (k === largest[i]) continue;
        quat[k] = step * rest[from++][i];
        squares += quat[k] * quat[k];
      }
      quat[largest[i]] = Math.sqrt(Math.max(0, 1 - squares));
      const length = Math.max(Math.hypot(...quat), 1e-9);
      for (let k = 0; k < 4; k++) this.words[to + k] = quat[k] / length;
    }
  }

  private linear(): void {
    for (const [name, { words, limit, least, absent }] of Object.entries(LINEAR)) {
      const [columns, step] = [this.codes.get(name), this.step(name)];
      words.forEach((at, c) => {
        for (let i = 0, to = at; i < this.count; i++, to += SURFEL_WORDS) {
          const value = columns ? step * columns[c][i] : absent!;
          this.words[to] = columns && least !== null ? logit(value, least) : within(value, limit);
        }
      });
    }
  }

  private colors(name: string, at: number): void {
    const [codes, step] = [this.column(name), this.step(name)];
    for (let i = 0; i < this.count; i++) color(this.words, at + i * SURFEL_WORDS, codes, 0, i, step);
  }

  private tiles(): void {
    const [[size], [extent]] = [this.column('size'), this.column('extent')];
    const [u, v] = [new Uint16Array(this.count), new Uint16Array(this.count)];
    const step = this.step('extent');
    const good = (exponent: number): boolean => exponent >= LEAST_EXPONENT && exponent <= MOST_EXPONENT;
    for (let i = 0, tile = 0, to = WORD.extent; i < this.count; i++, to += SURFEL_WORDS) {
      this.words[to] = EXTENT;
      if (size[i] === 0) continue;
      const [of_u, of_v] = [Math.floor(size[i] / 16), size[i] % 16];
      if (!good(of_u) || !good(of_v)) this.refuse('a tile has a side that is not a power of two from 4 to 4096');
      u[i] = 1 << of_u;
      v[i] = 1 << of_v;
      this.words[to] = clip(step * extent[tile++], ...EXTENTS);
    }
    const atlas = this.info.atlas;
    if (!atlas?.coded) {
      if (u.some((side) => side > 0)) this.refuse('a surfel has a tile, and there is no atlas');
      return;
    }
    const packing = pack(u, v, atlas.coded.pageWidth, atlas.coded.pageRows);
    if (packing.width !== atlas.width || packing.height !== atlas.height || packing.layers !== atlas.layers) {
      throw new DamagedBundle('bundle.json: width, height and layers of the atlas are not those of its tiles.');
    }
    u.forEach((side, i) => {
      if (side) setTile(this.words, i, [packing.x[i], packing.y[i], packing.layer[i], side, v[i]]);
    });
  }

  private alphas(): void {
    const [codes] = this.column('alpha');
    codes.forEach((code, i) => {
      if (!(code >= 0 && code <= 255)) this.refuse('an alpha is not a byte');
      this.numbers[i * SURFEL_WORDS + WORD.layer] |= alphaWord(code / 128);
    });
  }

  private viewColors(): Float32Array {
    const kind = this.info.viewColor;
    const [[counts], shape, colors] = ['view_count', 'term_shape', 'term_color'].map((name) => this.column(name));
    const [allowed, width] = [REDUCED_COUNTS[kind], REDUCED_WIDTH[kind]];
    if (!counts.every((count) => (allowed ? allowed.includes(count) : count >= 0 && count <= MAX_TERMS))) {
      this.refuse('a view colour has a number of terms that none can have');
    }
    if (setTerms(this.words, counts, width) !== this.terms) {
      this.refuse(`the view colours do not have the ${this.terms} terms of bundle.json`);
    }
    const { at, limits } = SHAPES[kind];
    const colored = at === 0 ? limits.length : 0;
    const out = new Float32Array(this.terms * width);
    const [shapeStep, colorStep] = [this.step('term_shape'), this.step('term_color')];
    for (let i = 0, to = 0; i < this.terms; i++, to += width) {
      for (let k = 0; k < limits.length; k++) out[to + at + k] = within(sinh(shapeStep * shape[k][i]), limits[k]);
      for (let c = 0; c < colors.length; c += 3) color(out, to + colored + c, colors, c, i, colorStep);
    }
    return out;
  }

  surfels(): Surfels {
    this.positions();
    this.rotations();
    this.linear();
    this.colors('residual', WORD.residual);
    this.colors('view_base', WORD.base);
    this.tiles();
    if (this.alpha) this.alphas();
    const terms = this.viewColors();
    const origin = originOf(this.info);
    centred(this.words, origin);
    return { count: this.count, words: this.words, terms, kind: KINDS[this.info.viewColor], origin, means: true };
  }
}

export const readCompactSurfels = (data: Uint8Array, info: Manifest): Surfels => new Decoder(data, info).surfels();
