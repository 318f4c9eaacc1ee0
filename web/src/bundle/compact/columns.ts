// Integer columns: docs/baking.md, "Columns of integers".
import { DamagedBundle } from '../../errors';
import { decodeIntegers } from './integers';

export interface Column {
  name: string;
  step: number | null;
  bytes: number[]; // of each number
}

export type Codes = Float64Array | Int32Array;

const bytesOf = ({ bytes }: Column): number => bytes.reduce((sum, size) => sum + size, 0);

// Checks that the columns are as expected ([name, numbers per row]) and fill the file.
export function checkColumns(columns: Column[], expected: [string, number][], size: number, file: string): void {
  const names = (list: string[]): string => list.join(', ') || 'none';
  const [found, wanted] = [columns.map((c) => c.name), expected.map(([name]) => name)];
  if (names(found) !== names(wanted)) throw new DamagedBundle(`${file}: its columns are ${names(found)}.`);
  columns.forEach((column, k) => {
    const [name, numbers] = expected[k];
    if (column.bytes.length !== numbers) {
      throw new DamagedBundle(`${file}: the column ${name} needs ${numbers} numbers.`);
    }
  });
  const stated = columns.reduce((sum, column) => sum + bytesOf(column), 0);
  if (stated !== size) throw new DamagedBundle(`${file} has ${size} bytes, its columns need ${stated}.`);
}

// Reads the columns of a file in order.
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

  // Reads the next column: an array of `rows` codes per number. blocks: as in decodeIntegers.
  read<T extends Codes>(rows: number, make: (rows: number) => T, blocks = 0): T[] {
    const { bytes } = this.columns[this.next++];
    const sums = blocks && bytes.length > 1 ? new Uint8Array(rows) : null;
    return bytes.map((size, number) => this.decode(size, make(rows), blocks, sums, number));
  }

  // Decodes one number of all rows by decodeIntegers.
  private decode<T extends Codes>(size: number, codes: T, blocks: number, sums: Uint8Array | null, number: number): T {
    try {
      decodeIntegers(this.data.subarray(this.at, this.at + size), codes, blocks, sums, number);
    } catch (error) {
      throw new DamagedBundle(`${this.file}: a column is damaged: ${error instanceof Error ? error.message : error}.`);
    }
    this.at += size;
    return codes;
  }
}
