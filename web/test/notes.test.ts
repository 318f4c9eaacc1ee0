import { readFileSync } from 'node:fs';
import { describe, expect, it } from 'vitest';
import type { Vec3 } from '../src/bundle/manifest';
import { SURFEL_WORDS } from '../src/bundle/tables';
import { keeper, keptOf } from '../src/view/crop';
import { cleared, noNotes, notesText, parseNotes } from '../src/view/notes';

const CAMERA = { position: [0, -3, 0.5], right: [1, 0, 0], forward: [0, 1, 0], target: [0, 0, 0] };
const LENS = [500, 500, 250, 240, 500, 480];
const file = () => ({
  format: 'bitymi-notes',
  version: 1,
  views: [
    { name: 'door', ...CAMERA, lens: LENS },
    { name: 'Tür <b>', ...CAMERA, lens: LENS },
  ] as unknown[],
  notes: [{ text: 'first line\nsecond', position: [0.1, -2, 3] }] as unknown[],
});
const view = (changes: object) => ({ views: [{ name: 'door', ...CAMERA, lens: LENS, ...changes }] });
const note = (changes: object) => ({ notes: [{ text: 'a', position: [1, 2, 3], ...changes }] });

describe('notes.json', () => {
  it('is read, and written as it was read', () => {
    const found = parseNotes(JSON.stringify(file()));
    expect(found.views.map(({ name }) => name)).toEqual(['door', 'Tür <b>']);
    expect(found.views[0].viewpoint.pose.down).toEqual([0, 0, -1]);
    expect(found.notes).toEqual(file().notes);
    expect(JSON.parse(notesText(found))).toEqual(file());
  });
  it.each([
    [/^format/, { format: 'bitymi-bundle' }],
    [/^version: 3 is newer/, { version: 3, more: 1 }],
    [/^more/, { more: 1 }],
    [/^unit/, { unit: { name: 'm', per_world: 1 } }],
    [/^views: /, { views: {} }],
    [/^views: /, { views: Array<object>(201).fill({}) }],
    [/^views.0.name/, view({ name: '' })],
    [/^views.0.name/, view({ name: 'x'.repeat(81) })],
    [/^views.1.name/, { views: [...view({}).views, ...view({}).views] }],
    [/^views.0: /, view({ right: [0, 2, 0] })],
    [/^views.0: /, view({ right: [0, 1, 0] })],
    [/^views.0: /, view({ position: [0, '1', 0] })],
    [/^views.0: /, view({ position: [0, 1e10, 0] })],
    [/^views.0: /, view({ lens: [0, 500, 0, 0, 500, 500] })],
    [/^views.0.html: /, view({ html: '<b>' })],
    [/^notes.0.text/, note({ text: '' })],
    [/^notes.0.text/, note({ text: 'x'.repeat(1001) })],
    [/^notes.0.text/, note({ text: 'a\u001b[2J' })],
    [/^notes.0.text/, note({ text: '\ud800' })],
    [/^notes.0.position/, note({ position: [1, 2] })],
    [/^notes.0.position/, note({ position: [1, 2, null] })],
    [/^notes.0: /, { notes: [5] }],
  ])('%s is refused', (words, changes) => {
    expect(() => parseNotes(JSON.stringify({ ...file(), ...changes }))).toThrowError(words);
  });
  it.each(['', '[]', 'null', '{"format"'])('is refused: %s', (text) => {
    expect(() => parseNotes(text)).toThrowError();
  });
  it('has text without control characters, but lines', () => {
    expect(cleared('a\u0000b\nc\ud800d\u0085')).toBe('ab\ncd');
  });
});

// Read by tests/bundle/test_notes.py, too.
const cases = JSON.parse(readFileSync(new URL('notes.json', import.meta.url), 'utf8')) as {
  file: Record<string, unknown>;
  refused: Record<string, unknown[]>;
  crop: object;
  points: Vec3[];
  kept: number[];
};

function changed(path: string, value: unknown): string {
  const file = structuredClone(cases.file);
  const keys = path.split('.');
  const last = keys.pop() ?? '';
  const at = keys.reduce((inner, key) => inner[key] as Record<string, unknown>, file);
  at[last] = value;
  return JSON.stringify(file);
}

describe('version 2', () => {
  it('is read, and written as it was read', () => {
    const found = parseNotes(JSON.stringify(cases.file));
    expect(found.measures.map(({ text }) => text)).toEqual(['Tür <b>', '']);
    expect(JSON.parse(notesText(found))).toEqual(cases.file);
    for (const without of ['measures', 'unit', 'crop', 'hidden']) {
      const file = Object.fromEntries(Object.entries(cases.file).filter(([key]) => key !== without));
      expect(JSON.parse(notesText(parseNotes(JSON.stringify(file))))).toEqual(file);
    }
  });
  it('is not written where nothing of it is used', () => {
    const used = parseNotes(JSON.stringify(cases.file));
    expect(JSON.parse(notesText({ ...noNotes(), views: used.views, notes: used.notes }))).toMatchObject({ version: 1 });
    expect(JSON.parse(notesText({ ...noNotes(), hidden: used.hidden }))).toMatchObject({ version: 2 });
  });
  it.each(Object.keys(cases.refused))('%s is refused', (path) => {
    const named = path.split('.').slice(0, 2).join('.');
    for (const value of cases.refused[path]) {
      expect(() => parseNotes(changed(path, value)), JSON.stringify(value)).toThrowError(new RegExp(`^${named}`));
    }
  });
  it('has limits', () => {
    const { measures, hidden } = cases.file as Record<string, unknown[]>;
    const many = (list: unknown[], count: number): unknown[] => Array<unknown>(count).fill(list[0]);
    expect(() => parseNotes(changed('measures', many(measures, 501)))).toThrowError(/^measures/);
    expect(() => parseNotes(changed('hidden', many(hidden, 201)))).toThrowError(/^hidden/);
    parseNotes(changed('hidden', many(hidden, 200)));
  });
  it('hides surfels by their centres, as Python does', () => {
    const cropping = parseNotes(JSON.stringify({ ...cases.file, ...cases.crop }));
    expect(cases.points.map((x) => Number(keeper(cropping)(x)))).toEqual(cases.kept);
    const words = new Float32Array(SURFEL_WORDS * cases.points.length);
    const origin: Vec3 = [0.5, -0.25, 1];
    cases.points.forEach((x, i) => words.set([x[0] - 0.5, x[1] + 0.25, x[2] - 1], i * SURFEL_WORDS));
    const surfels = { words, count: cases.points.length, origin, terms: new Float32Array(), kind: 0, means: false };
    expect([...keptOf(surfels, cropping)]).toEqual(cases.kept);
  });
});
