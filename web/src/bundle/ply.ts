// Binary little-endian PLY of float and int properties.
import { DamagedBundle } from '../errors';

export interface Element {
  count: number;
  stride: number; // bytes
  start: number; // byte offset in the file
  columns: Map<string, { at: number; type: 'float' | 'int' }>;
}

const HEADER_LIMIT = 1 << 16;

const isType = (word: string): word is 'float' | 'int' => word === 'float' || word === 'int';

export function parsePly(data: ArrayBuffer): Map<string, Element> {
  const head = new TextDecoder('latin1').decode(new Uint8Array(data, 0, Math.min(data.byteLength, HEADER_LIMIT)));
  const end = head.indexOf('end_header\n');
  const lines = head.slice(0, Math.max(end, 0)).split('\n');
  if (end < 0 || lines[0] !== 'ply' || lines[1] !== 'format binary_little_endian 1.0') {
    throw new DamagedBundle('surfels.ply is not a binary little-endian PLY file.');
  }
  const elements = new Map<string, Element>();
  let last: Element | null = null;
  for (const line of lines.slice(2)) {
    const words = line.split(' ');
    if (words[0] === 'element' && words.length === 3 && /^\d{1,10}$/.test(words[2]) && !elements.has(words[1])) {
      last = { count: Number(words[2]), stride: 0, start: 0, columns: new Map() };
      elements.set(words[1], last);
    } else if (words[0] === 'property' && last && isType(words[1]) && !last.columns.has(words[2])) {
      last.columns.set(words[2], { at: last.stride, type: words[1] });
      last.stride += 4;
    } else if (words[0] !== 'comment' && line !== '') {
      throw new DamagedBundle('surfels.ply has a header that cannot be read.');
    }
  }
  let at = end + 'end_header\n'.length;
  for (const element of elements.values()) {
    element.start = at;
    at += element.count * element.stride;
  }
  if (at !== data.byteLength) {
    throw new DamagedBundle(`surfels.ply has ${data.byteLength} bytes; its header asks for ${at}.`);
  }
  return elements;
}

export class Table {
  readonly count: number;
  private readonly view: DataView;

  constructor(
    data: ArrayBuffer,
    private readonly element: Element,
    private readonly name: string,
  ) {
    this.count = element.count;
    this.view = new DataView(data, element.start, element.count * element.stride);
  }
  has(column: string): boolean {
    return this.element.columns.has(column);
  }
  // Copies a column to `to`, from `first` on with stride `step`.
  into(column: string, to: Float32Array | Uint32Array | Int32Array, first: number, step: number): void {
    const stored = this.element.columns.get(column);
    const type = to instanceof Float32Array ? 'float' : 'int';
    if (!stored || stored.type !== type) {
      throw new DamagedBundle(`surfels.ply: ${this.name} has no property ${column} of type ${type}.`);
    }
    const stride = this.element.stride;
    for (let i = 0, at = stored.at, k = first; i < this.count; i++, at += stride, k += step) {
      to[k] = type === 'float' ? this.view.getFloat32(at, true) : this.view.getInt32(at, true);
    }
  }
  // Counts the columns name_0, name_1, ...
  width(name: string): number {
    let n = 0;
    while (this.has(`${name}_${n}`)) n++;
    return n;
  }
}
