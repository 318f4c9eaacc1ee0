// Surfels as struct Surfel of scene.wgsl, and the terms of the view colours.
import { DamagedBundle } from '../errors';
import type { Manifest, Vec3, ViewKind } from './manifest';
import { Table, parsePly } from './ply';
import {
  EXTENT,
  EXTENTS,
  KINDS,
  REDUCED_WIDTH,
  LIMITS,
  MAX_TERMS,
  PLY,
  SURFEL_WORDS,
  TERM_LIMITS,
  UNIT_SLACK,
  WHOLE,
  WORD,
} from './tables';

export interface Surfels {
  count: number;
  words: Float32Array;
  terms: Float32Array;
  kind: number;
  origin: Vec3; // subtracted from the means
  means: boolean; // whether mean residuals of tiles are known
}

// Encodes a surfel's mean alpha m for the layer's word: scene.wgsl.
export const alphaWord = (m: number): number => (Math.min(Math.round(128 * m), 255) << 24) >>> 0;
export const layerIn = (word: number): number => word & 0xffffff;
export const alphaIn = (word: number): number => (word >>> 24) / 128;

// Returns the scene's centre, as the origin of positions, which in float32 lack precision far from the world's.
export const originOf = ({ bounds }: Manifest): Vec3 => bounds.min.map((low, c) => (low + bounds.max[c]) / 2) as Vec3;

export function centred(words: Float32Array, origin: Vec3): void {
  for (let i = WORD.mean; i < words.length; i += SURFEL_WORDS) {
    for (let c = 0; c < 3; c++) words[i + c] -= origin[c];
  }
}

export function setTile(
  words: Float32Array,
  i: number,
  tile: [x: number, y: number, layer: number, u: number, v: number],
): void {
  const [x, y, layer, u, v] = tile;
  const numbers = new Uint32Array(words.buffer, 4 * i * SURFEL_WORDS, SURFEL_WORDS);
  numbers.set([x, y, u | (v << 16)], WORD.tile);
  numbers[WORD.layer] = layer;
}

// Sets each surfel's span in the list of terms; returns the number of terms.
export function setTerms(words: Float32Array, counts: ArrayLike<number>, width: number): number {
  const numbers = new Uint32Array(words.buffer);
  let first = 0;
  for (let i = 0, to = 0; i < counts.length; i++, to += SURFEL_WORDS) {
    numbers[to + WORD.firstTerm] = first * width;
    numbers[to + WORD.terms] = counts[i];
    first += counts[i];
  }
  return first;
}

function reduced(rows: Table, terms: Table, words: Float32Array, kind: ViewKind): Float32Array {
  const width = REDUCED_WIDTH[kind];
  for (let c = 0; c < 3; c++) rows.into(`view_base_${c}`, words, WORD.base + c, SURFEL_WORDS);
  const counts = new Int32Array(rows.count);
  rows.into('view_terms', counts, 0, 1);
  const wrong = counts.findIndex((count) => count < 0 || count > MAX_TERMS);
  if (wrong >= 0) throw new DamagedBundle(`surfels.ply: view_terms is wrong in row ${wrong}.`);
  if (setTerms(words, counts, width) !== terms.count) {
    throw new DamagedBundle('surfels.ply: view_terms does not count the rows of view_term.');
  }
  const out = new Float32Array(terms.count * width);
  for (let c = 0; c < width; c++) terms.into(`term_${c}`, out, c, width);
  return out;
}

// Reads all terms of every surfel from columns (name, width), interleaved by term.
function whole(rows: Table, words: Float32Array, parts: [string, number][], base: string | null): Float32Array {
  const width = parts.reduce((sum, [, w]) => sum + w, 0);
  const count = rows.width(parts[0][0]) / parts[0][1];
  if (parts.some(([name, w]) => rows.width(name) !== count * w)) {
    throw new DamagedBundle('surfels.ply: the columns of the view colour do not fit together.');
  }
  const out = new Float32Array(rows.count * count * width);
  let from = 0;
  for (const [name, w] of parts) {
    for (let k = 0; k < count; k++) {
      for (let c = 0; c < w; c++) rows.into(`${name}_${k * w + c}`, out, k * width + from + c, count * width);
    }
    from += w;
  }
  if (base !== null) for (let c = 0; c < 3; c++) rows.into(`${base}_${c}`, words, WORD.base + c, SURFEL_WORDS);
  setTerms(words, new Uint32Array(rows.count).fill(count), width);
  return out;
}

function tiles(rows: Table, words: Float32Array, info: Manifest): void {
  const columns = ['tile_x', 'tile_y', 'tile_layer', 'tile_ru', 'tile_rv'].map((name) => {
    const column = new Int32Array(rows.count);
    rows.into(name, column, 0, 1);
    return column;
  });
  const [width, height, layers] = info.atlas ? [info.atlas.width, info.atlas.height, info.atlas.layers] : [0, 0, 1];
  for (let i = 0; i < rows.count; i++) {
    const [x, y, layer, ru, rv] = columns.map((column) => column[i]);
    const fits = x >= 0 && y >= 0 && ru >= 0 && rv >= 0 && x + ru <= width && y + rv <= height;
    if (!fits || layer < 0 || layer >= layers || ru > 0 !== rv > 0) {
      throw new DamagedBundle(`surfels.ply: the tile of surfel ${i} lies outside the atlas.`);
    }
    setTile(words, i, [x, y, layer, ru, rv]);
  }
}

function alphas(rows: Table, words: Float32Array): void {
  const numbers = new Uint32Array(words.buffer);
  const means = new Float32Array(rows.count);
  rows.into('alpha', means, 0, 1);
  means.forEach((m, i) => {
    if (!(m >= 0 && m <= 2)) throw new DamagedBundle(`surfels.ply: alpha is not from 0 to 2 in row ${i}.`);
    numbers[i * SURFEL_WORDS + WORD.layer] |= alphaWord(m);
  });
}

// Checks the same limits as from_columns of bundle/surfel_table.py.
function checkLimits(words: Float32Array, terms: Float32Array, ofTerm: readonly number[]): void {
  const refuse = (name: string, i: number): never => {
    throw new DamagedBundle(`surfels.ply: ${name} is beyond its limit, or no number, in row ${i}.`);
  };
  for (let i = 0, at = 0; at < words.length; i++, at += SURFEL_WORDS) {
    for (const [name, [first, count, most]] of Object.entries(LIMITS)) {
      for (let c = first; c < first + count; c++) if (!(Math.abs(words[at + c]) <= most)) refuse(name, i);
    }
    const extent = words[at + WORD.extent];
    if (!(extent >= EXTENTS[0] && extent <= EXTENTS[1])) refuse('tile_extent', i);
    const length = Math.hypot(...words.subarray(at + WORD.quat, at + WORD.quat + 4));
    if (!(Math.abs(length - 1) <= UNIT_SLACK)) {
      throw new DamagedBundle(`surfels.ply: rot_0 to rot_3 are not of length 1 in row ${i}.`);
    }
  }
  const width = ofTerm.length;
  const wrong = terms.findIndex((x, k) => !(Math.abs(x) <= ofTerm[k % width]));
  if (wrong >= 0) refuse('a view colour', Math.floor(wrong / width));
}

export function readSurfels(data: ArrayBuffer, info: Manifest): Surfels {
  const elements = parsePly(data);
  const vertex = elements.get('vertex');
  if (!vertex || vertex.count !== info.count) {
    throw new DamagedBundle(`surfels.ply has not the ${info.count} surfels of bundle.json.`);
  }
  const rows = new Table(data, vertex, 'vertex');
  const words = new Float32Array(rows.count * SURFEL_WORDS);
  const copy = (column: string, at: number): void => rows.into(column, words, at, SURFEL_WORDS);
  const fill = (at: number, value: number): void => {
    for (let to = at; to < words.length; to += SURFEL_WORDS) words[to] = value;
  };
  for (const [column, [at, absent]] of Object.entries(PLY)) {
    if (absent === null || rows.has(column)) copy(column, at);
    else fill(at, absent);
  }
  if (rows.has('tile_extent')) copy('tile_extent', WORD.extent);
  else fill(WORD.extent, info.atlas?.extent ?? EXTENT);
  const means = rows.has('residual_0');
  if (means) [0, 1, 2].forEach((c) => copy(`residual_${c}`, WORD.residual + c));
  tiles(rows, words, info);
  if (info.atlas?.alphaScale) alphas(rows, words);
  const term = elements.get('view_term');
  const form = WHOLE[info.viewColor];
  const terms = term
    ? reduced(rows, new Table(data, term, 'view_term'), words, info.viewColor)
    : whole(rows, words, Object.entries(form.parts), form.base);
  checkLimits(words, terms, TERM_LIMITS[info.viewColor === 'sv' && !term ? 'sv sites' : info.viewColor]);
  const origin = originOf(info);
  centred(words, origin);
  return { count: rows.count, words, terms, kind: term ? KINDS[info.viewColor] : form.kind, origin, means };
}
