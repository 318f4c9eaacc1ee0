import { describe, expect, it } from 'vitest';
import { cleared, notesText, parseNotes } from '../src/view/notes';

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
    [/^format/, { version: 2 }],
    [/^the whole/, { more: 1 }],
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
    [/^views.0: /, view({ html: '<b>' })],
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
