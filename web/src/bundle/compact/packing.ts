// Packs tiles into the pages of an atlas, as bitymi_ns/codec/packing.py.
import { DamagedBundle } from '../../errors';
import { GRID, ROWS } from '../tables';

const MOST_LAYERS = 2048;

interface Shelf {
  y: number;
  used: number;
}

const roundUp = (value: number, step: number): number => Math.ceil(value / step) * step;

// Packs tiles of sides (u, v), powers of two; 0: no tile. Returns sides and number of the pages, and place and page of
// every tile.
export function pack(u: Uint16Array, v: Uint16Array, pageWidth: number, mostRows: number) {
  const refuse = (): never => {
    throw new DamagedBundle('bundle.json: the tiles do not fit into pages of this size.');
  };
  if (pageWidth < GRID || !Number.isInteger(Math.log2(pageWidth)) || mostRows < ROWS || mostRows % ROWS) refuse();
  const n = u.length;
  const found = { x: new Uint32Array(n), y: new Uint32Array(n), layer: new Uint32Array(n) };
  let [area, widest, tallest] = [0, 0, 0];
  const classes = new Map<number, number[]>(); // by sides, in tile order
  for (let i = 0; i < n; i++) {
    if (!u[i]) continue;
    area += u[i] * v[i];
    widest = Math.max(widest, u[i]);
    tallest = Math.max(tallest, v[i]);
    const key = v[i] * 65536 + u[i];
    const alike = classes.get(key);
    if (alike) alike.push(i);
    else classes.set(key, [i]);
  }
  if (!area) return { width: GRID, height: GRID, layers: 1, ...found };
  if (widest > pageWidth || mostRows % tallest) refuse();
  let width = Math.max(GRID, widest);
  while (width < pageWidth && width * width < area) width *= 2;

  let shelves: Shelf[] = []; // with room left, in order of opening
  let rows = 0;
  for (const key of [...classes.keys()].sort((a, b) => b - a)) {
    const tiles = classes.get(key)!;
    const [r_u, r_v] = [key % 65536, Math.floor(key / 65536)];
    let next = 0;
    const fill = (shelf: Shelf): void => {
      for (; next < tiles.length && shelf.used + r_u <= width; next++, shelf.used += r_u) {
        found.x[tiles[next]] = shelf.used;
        found.y[tiles[next]] = shelf.y;
      }
    };
    shelves.forEach(fill);
    let last: Shelf | null = null;
    while (next < tiles.length) {
      last = { y: rows, used: 0 };
      fill(last);
      rows += r_v;
    }
    if (last) shelves.push(last);
    shelves = shelves.filter((shelf) => shelf.used < width);
  }
  const pages = Math.ceil(rows / mostRows);
  if (pages > MOST_LAYERS) refuse();
  const height = roundUp(Math.ceil(rows / pages), rows >= ROWS ? Math.max(ROWS, tallest) : GRID);
  for (let i = 0; i < n; i++) {
    found.layer[i] = Math.floor(found.y[i] / height);
    found.y[i] %= height;
  }
  return { width, height, layers: Math.ceil(rows / height), ...found };
}
