// Saved views, notes, measures and crop of a scene: notes.json, as in bitymi_ns/bundle/notes.py.
import type { Vec3 } from '../bundle/manifest';
import { type Box, type Cropping, crops } from './crop';
import type { Quat } from './rotation';
import { type Viewpoint, cameraOf, viewpointOf } from './share';

export interface SavedView {
  name: string;
  viewpoint: Viewpoint;
}
export interface Note {
  text: string; // shown as text, never as HTML
  position: Vec3;
}
export interface Measure {
  points: [Vec3, Vec3];
  text: string;
}
// Unit in which lengths are shown: `perWorld` of them make a unit of the scene.
export interface Unit {
  name: string;
  perWorld: number;
}
export interface Notes extends Cropping {
  views: SavedView[];
  notes: Note[];
  measures: Measure[];
  unit: Unit | null;
}
export const noNotes = (): Notes => ({ views: [], notes: [], measures: [], unit: null, crop: {}, hidden: [] });

export const MOST_VIEWS = 200;
export const MOST_NOTES = 500;
export const MOST_MEASURES = 500;
export const MOST_HIDDEN = 200;
export const LONGEST_NAME = 80; // characters
export const LONGEST_TEXT = 1000;
export const LONGEST_UNIT = 12;
const FORMAT = 'bitymi-notes';
const NEWEST = 2; // version; 1 is written where nothing of version 2 is used
const FARTHEST = 1e9;
const UNIT_LENGTH = 1e-3; // tolerance
// eslint-disable-next-line no-control-regex
const CONTROLS = /[\u0000-\u0009\u000b-\u001f\u007f-\u009f]|\p{Cs}/gu;

type Json = Record<string, unknown>;
const WHOLE = 'the whole';

const refuse = (where: string, what: string): never => {
  throw new Error(`${where}: ${what}`);
};

function keysOf(value: unknown, where: string, keys: string[], optional: string[] = []): Json {
  if (typeof value !== 'object' || value === null || Array.isArray(value)) return refuse(where, 'must be an object');
  const missing = keys.find((key) => !(key in value));
  if (missing) return refuse(where, `must have ${missing}`);
  const more = Object.keys(value).find((key) => !keys.includes(key) && !optional.includes(key));
  if (more) return refuse(where === WHOLE ? more : `${where}.${more}`, 'is no such entry');
  return value as Json;
}

function rows(value: unknown, where: string, most: number): unknown[] {
  if (!Array.isArray(value) || value.length > most) return refuse(where, `must be a list of at most ${most}`);
  return value as unknown[];
}

function textOf(value: unknown, where: string, most: number, least = 1): string {
  const length = typeof value === 'string' ? [...value].length : -1;
  if (typeof value !== 'string' || length < least || length > most || value !== cleared(value)) {
    return refuse(where, `must be text of ${least} to ${most} characters without control characters`);
  }
  return value;
}

function numberOf(value: unknown, where: string, least = -FARTHEST): number {
  if (typeof value === 'number' && value >= least && value <= FARTHEST) return value;
  return refuse(where, `must be a number from ${least} to ${FARTHEST}`);
}

const WORDS = ['', '', 'two', 'three', 'four'];
function numbersOf(value: unknown, where: string, count = 3): number[] {
  const good = (x: unknown): boolean => typeof x === 'number' && Math.abs(x) <= FARTHEST;
  if (Array.isArray(value) && value.length === count && value.every(good)) return value as number[];
  return refuse(where, `must be ${WORDS[count]} numbers`);
}
const pointOf = (value: unknown, where: string): Vec3 => numbersOf(value, where) as Vec3;

function unitVector(value: unknown, where: string, count: number): number[] {
  const vector = numbersOf(value, where, count);
  if (!(Math.abs(Math.hypot(...vector) - 1) <= UNIT_LENGTH)) refuse(where, 'must have the length 1');
  return vector;
}

function boxOf(value: unknown, where: string): Box {
  const { center, half, quat } = keysOf(value, where, ['center', 'half', 'quat']);
  const sides = pointOf(half, `${where}.half`);
  if (Math.min(...sides) <= 0) refuse(`${where}.half`, 'must be positive');
  const turn = unitVector(quat, `${where}.quat`, 4) as Quat;
  return { center: pointOf(center, `${where}.center`), half: sides, quat: turn };
}

function cropOf(value: unknown): Cropping['crop'] {
  const { box, floor } = keysOf(value, 'crop', [], ['box', 'floor']);
  const cropped: Cropping['crop'] = {};
  if (box !== undefined) cropped.box = boxOf(box, 'crop.box');
  if (floor !== undefined) {
    const { normal, offset } = keysOf(floor, 'crop.floor', ['normal', 'offset']);
    const direction = unitVector(normal, 'crop.floor.normal', 3) as Vec3;
    cropped.floor = { normal: direction, offset: numberOf(offset, 'crop.floor.offset') };
  }
  return cropped;
}

function unitOf(value: unknown): Unit {
  const { name, per_world: perWorld } = keysOf(value, 'unit', ['name', 'per_world']);
  return { name: textOf(name, 'unit.name', LONGEST_UNIT), perWorld: numberOf(perWorld, 'unit.per_world', 1e-9) };
}

function measureOf(value: unknown, where: string): Measure {
  const { points, text } = keysOf(value, where, ['points'], ['text']);
  const pair = rows(points, `${where}.points`, 2);
  if (pair.length < 2) refuse(`${where}.points`, 'must be two points');
  const [a, b] = pair.map((point, k) => pointOf(point, `${where}.points.${k}`));
  return { points: [a, b], text: text === undefined ? '' : textOf(text, `${where}.text`, LONGEST_NAME, 0) };
}

// Removes control characters.
export const cleared = (text: string): string => text.replace(CONTROLS, '');

// Throws an error that names an invalid entry.
export function parseNotes(text: string): Notes {
  const json: unknown = JSON.parse(text);
  const { version } = (json ?? {}) as Json;
  if (Number.isInteger(version) && (version as number) > NEWEST) {
    refuse('version', `${String(version)} is newer than ${NEWEST}, which this page reads: export the page again`);
  }
  const since2 = version === 1 ? [] : ['measures', 'unit', 'crop', 'hidden'];
  const root = keysOf(json, WHOLE, ['format', 'version', 'views', 'notes'], since2);
  if (root.format !== FORMAT) refuse('format', `must be ${FORMAT}`);
  if (version !== 1 && version !== 2) refuse('version', `must be 1 or ${NEWEST}`);
  const names = new Set<string>();
  const views = rows(root.views, 'views', MOST_VIEWS).map((view, k) => {
    const where = `views.${k}`;
    const { name, ...camera } = keysOf(view, where, ['name', 'position', 'right', 'forward', 'target', 'lens']);
    const title = textOf(name, `${where}.name`, LONGEST_NAME);
    if (names.has(title)) refuse(`${where}.name`, 'is there twice');
    names.add(title);
    return { name: title, viewpoint: viewpointOf(camera) ?? refuse(where, 'must be a camera') };
  });
  const notes = rows(root.notes, 'notes', MOST_NOTES).map((note, k) => {
    const { text: words, position } = keysOf(note, `notes.${k}`, ['text', 'position']);
    const at = pointOf(position, `notes.${k}.position`);
    return { text: textOf(words, `notes.${k}.text`, LONGEST_TEXT), position: at };
  });
  const { measures = [], unit, crop, hidden = [] } = root;
  return {
    views,
    notes,
    measures: rows(measures, 'measures', MOST_MEASURES).map((measure, k) => measureOf(measure, `measures.${k}`)),
    unit: unit === undefined ? null : unitOf(unit),
    crop: crop === undefined ? {} : cropOf(crop),
    hidden: rows(hidden, 'hidden', MOST_HIDDEN).map((box, k) => boxOf(box, `hidden.${k}`)),
  };
}

export function notesText(all: Notes): string {
  const { views, notes, measures, unit, crop, hidden } = all;
  const cameras = views.map(({ name, viewpoint }) => ({ name, ...cameraOf(viewpoint) }));
  const since2 = measures.length > 0 || unit !== null || crops(all);
  const file = { format: FORMAT, version: since2 ? 2 : 1, views: cameras, notes };
  if (measures.length) {
    const pairs = measures.map(({ points, text }) => (text ? { points, text } : { points }));
    Object.assign(file, { measures: pairs });
  }
  if (unit) Object.assign(file, { unit: { name: unit.name, per_world: unit.perWorld } });
  if (crop.box ?? crop.floor) Object.assign(file, { crop });
  if (hidden.length) Object.assign(file, { hidden });
  return JSON.stringify(file, null, 1);
}
