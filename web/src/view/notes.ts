// Saved views and notes of a scene: notes.json, as in bitymi_ns/bundle/notes.py.
import type { Vec3 } from '../bundle/manifest';
import { type Viewpoint, cameraOf, viewpointOf } from './share';

export interface SavedView {
  name: string;
  viewpoint: Viewpoint;
}
export interface Note {
  text: string; // shown as text, never as HTML
  position: Vec3;
}
export interface Notes {
  views: SavedView[];
  notes: Note[];
}

export const MOST_VIEWS = 200;
export const MOST_NOTES = 500;
export const LONGEST_NAME = 80; // characters
export const LONGEST_TEXT = 1000;
const FORMAT = 'bitymi-notes';
const FARTHEST = 1e9;
// eslint-disable-next-line no-control-regex
const CONTROLS = /[\u0000-\u0009\u000b-\u001f\u007f-\u009f]|\p{Cs}/gu;

type Json = Record<string, unknown>;

const refuse = (where: string, what: string): never => {
  throw new Error(`${where}: ${what}`);
};

function keysOf(value: unknown, where: string, keys: string[]): Json {
  if (typeof value !== 'object' || value === null || Array.isArray(value)) return refuse(where, 'must be an object');
  const found = Object.keys(value);
  if (found.length !== keys.length || !keys.every((key) => key in value)) {
    return refuse(where, `must have ${keys.join(', ')} and nothing else`);
  }
  return value as Json;
}

function rows(value: unknown, where: string, most: number): unknown[] {
  if (!Array.isArray(value) || value.length > most) return refuse(where, `must be a list of at most ${most}`);
  return value as unknown[];
}

function textOf(value: unknown, where: string, most: number): string {
  if (typeof value !== 'string' || !value || [...value].length > most || value !== cleared(value)) {
    return refuse(where, `must be text of 1 to ${most} characters without control characters`);
  }
  return value;
}

// Removes control characters.
export const cleared = (text: string): string => text.replace(CONTROLS, '');

// Parses notes.json; throws an error that names an invalid entry.
export function parseNotes(text: string): Notes {
  const root = keysOf(JSON.parse(text), 'the whole', ['format', 'version', 'views', 'notes']);
  if (root.format !== FORMAT || root.version !== 1) refuse('format', `must be ${FORMAT}, version 1`);
  const names = new Set<string>();
  const views = rows(root.views, 'views', MOST_VIEWS).map((each, k) => {
    const where = `views.${k}`;
    const { name, ...camera } = keysOf(each, where, ['name', 'position', 'right', 'forward', 'target', 'lens']);
    const found = textOf(name, `${where}.name`, LONGEST_NAME);
    if (names.has(found)) refuse(`${where}.name`, 'is there twice');
    names.add(found);
    return { name: found, viewpoint: viewpointOf(camera) ?? refuse(where, 'must be a camera') };
  });
  const notes = rows(root.notes, 'notes', MOST_NOTES).map((each, k) => {
    const { text: words, position } = keysOf(each, `notes.${k}`, ['text', 'position']);
    const good = (x: unknown): boolean => typeof x === 'number' && Math.abs(x) <= FARTHEST;
    if (!Array.isArray(position) || position.length !== 3 || !position.every(good)) {
      refuse(`notes.${k}.position`, 'must be three numbers');
    }
    return { text: textOf(words, `notes.${k}.text`, LONGEST_TEXT), position: position as Vec3 };
  });
  return { views, notes };
}

export function notesText({ views, notes }: Notes): string {
  const cameras = views.map(({ name, viewpoint }) => ({ name, ...cameraOf(viewpoint) }));
  return JSON.stringify({ format: FORMAT, version: 1, views: cameras, notes }, null, 1);
}
