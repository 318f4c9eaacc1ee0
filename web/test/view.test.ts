import { describe, expect, it } from 'vitest';
import type { Vec3 } from '../src/bundle/manifest';
import { commonTarget, correctionAt, firstPose, parseCameras } from '../src/view/cameras';
import { Pace } from '../src/render/screen';
import { DEFAULT_LENS, View, look, lookAt, moved, orbit, rolled } from '../src/view/pose';
import { fromHash, toHash } from '../src/view/share';
import { partOf, samplingOf, sizeOf } from '../src/view/size';
import { dot, length, subtract } from '../src/view/vector';
import { SURFEL_WORDS, WORD } from '../src/bundle/tables';

const UP: Vec3 = [0, 0, 1];
const pose = lookAt([4, 0, 1], [0, 0, 0], UP);

describe('poses', () => {
  it('are right-handed and look at their target', () => {
    expect(dot(pose.right, pose.down)).toBeCloseTo(0);
    expect(dot(pose.down, UP)).toBeLessThan(0);
    expect(length(pose.down)).toBeCloseTo(1);
  });
  it('keep distance and aim while they orbit', () => {
    const next = orbit(pose, [0, 0, 0], UP, 0.7, 0.3);
    expect(length(next.position)).toBeCloseTo(length(pose.position));
    expect(dot(next.forward, next.position) / length(next.position)).toBeCloseTo(-1);
    expect(dot(next.right, UP)).toBeCloseTo(0);
  });
  it('start on the side of the cameras, which are around the origin', () => {
    const aside = firstPose([0, 2, 0], 2, UP);
    expect(length(subtract(aside.position, [0, 1, 0]))).toBeLessThan(1e-9);
    expect(length(subtract(aside.forward, [0, 1, 0]))).toBeLessThan(1e-9);
    const around = firstPose([0.1, 0, 0], 2, UP);
    expect(length(subtract(around.position, [0.1, 0, 0]))).toBeCloseTo(1);
    expect(around.position[2]).toBeGreaterThan(0.2);
    expect(length(firstPose([0, 0, 0], 100, UP).position)).toBeCloseTo(50); // another frame
    expect(length(firstPose([0, 0, 0], 0.1, UP).position)).toBeCloseTo(0.16);
  });
  it('do not tilt beyond the vertical', () => {
    let p = pose;
    for (let k = 0; k < 200; k++) p = look(p, UP, 0, 0.05);
    expect(dot(p.down, UP)).toBeLessThan(0.01);
  });
  it('show all of a photograph on any screen', () => {
    const view = View.contain(pose, { fx: 100, fy: 110, cx: 20, cy: 30, width: 40, height: 60 }, 300, 120);
    expect([view.fx, view.fy, view.cx, view.cy]).toEqual([200, 220, 150, 60]);
  });
});

describe('links', () => {
  it('bring back the view', () => {
    const shared = { pose, lens: DEFAULT_LENS, target: [0, 0, 0] as Vec3, show: 'depth' as const, residuals: false };
    const found = fromHash(toHash(shared));
    expect(found?.show).toBe('depth');
    expect(found?.residuals).toBe(false);
    expect(length(subtract(found!.pose.position, pose.position))).toBeLessThan(1e-6);
    expect(length(subtract(found!.pose.down, pose.down))).toBeLessThan(1e-6);
  });
  it.each([
    '',
    '#p=1,2',
    '#p=1,2,x&r=1,0,0,0,0,1&t=0,0,0&l=1,1,1,1,1,1',
    '#p=1,2,3&r=9,0,0,0,0,1&t=0,0,0&l=1,1,1,1,1,1',
  ])('that are none are not taken: %s', (hash) => expect(fromHash(hash)).toBeNull());
});

describe('the capture', () => {
  const row = {
    name: 'a',
    held_out: true,
    viewmat: [1, 0, 0, -1, 0, 1, 0, -2, 0, 0, 1, -3, 0, 0, 0, 1],
    ...{ fx: 1, fy: 1, cx: 1, cy: 1, width: 2, height: 2 },
  };
  it('has cameras where its file says so', () => {
    const [camera] = parseCameras(JSON.stringify({ cameras: [row, { name: 'broken' }, 3] }));
    expect(camera.pose.position).toEqual([1, 2, 3]);
    expect(camera.heldOut).toBe(true);
    expect(parseCameras('{')).toEqual([]);
    expect(parseCameras('{"cameras": 3}')).toEqual([]);
  });
  it('has the exposures of photographs, for their cameras alone', () => {
    const affine = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
    const given = [[2, 3, 4], affine, [1, 2], [1, 2, '3'], [1, 2, null], undefined];
    const rows = given.map((correction, k) => ({
      ...row,
      correction,
      viewmat: row.viewmat.map((x, i) => (i === 3 ? -k : x)),
    }));
    const cameras = parseCameras(JSON.stringify({ cameras: rows }));
    const gains = [...[2, 0, 0, 0], ...[0, 3, 0, 0], ...[0, 0, 4, 0]];
    expect(cameras.map((camera) => camera.correction)).toEqual([gains, affine, null, null, null, null]);
    const at = cameras[1].pose;
    const linked = fromHash(toHash({ pose: at, lens: DEFAULT_LENS, target: UP, show: 'color', residuals: true }))!.pose;
    const poses = [at, linked, moved(at, 1e-3, 0, 0), rolled(at, 0.01), cameras[2].pose];
    expect(poses.map((each) => correctionAt(cameras, each))).toEqual([affine, affine, null, null, null]);
  });
  it('does not reach out of the bundle', () => {
    const photograph = (name: string): string | null =>
      parseCameras(JSON.stringify({ cameras: [{ ...row, photograph: name }] }))[0].photograph;
    expect(photograph('a.jpg')).toBe('a.jpg');
    expect(photograph('../a.jpg')).toBeNull();
    expect(photograph('https://x/a.jpg')).toBeNull();
  });
  it('is looked at in the middle of what its cameras see', () => {
    const make = (at: Vec3): ReturnType<typeof parseCameras>[number] => ({
      ...parseCameras(JSON.stringify({ cameras: [row] }))[0],
      pose: lookAt(at, [1, 1, 0], UP),
    });
    const found = commonTarget([make([5, 0, 1]), make([0, 6, 1]), make([-3, -2, 2])]);
    expect(length(subtract(found!, [1, 1, 0]))).toBeLessThan(1e-6);
    expect(commonTarget([make([5, 0, 1])])).toBeNull();
  });
});

describe('the pace', () => {
  it('lowers the resolution until frames take a sixtieth of a second, and raises it again', () => {
    const pace = new Pace();
    for (let k = 0; k < 60; k++) pace.took(40 * pace.scale ** 2);
    expect(40 * pace.scale ** 2).toBeLessThan(17);
    expect(pace.scale).toBeGreaterThan(0.4);
    for (let k = 0; k < 60; k++) pace.took(4 * pace.scale ** 2);
    expect(pace.scale).toBeGreaterThan(0.92);
  });
});

describe('views of other sizes', () => {
  // what bitymi_ns.scene.sampling gives for a thousand pixels
  it.each([
    [1 / 64, 38, 0.59375],
    [0.1, 6, 0.6],
    [0.25, 3, 0.75],
    [0.3, 3, 0.9],
    [0.34, 2, 0.68],
    [0.5, 2, 1],
    [0.59, 2, 1.18],
    [0.6, 1, 0.682859316],
    [0.74, 1, 0.977314471],
    [0.8, 1, 1],
    [1.4, 1, 1],
    [1.6, 1, 1.168242471],
    [1.9, 1, 1.76748927],
    [3, 1, 3],
  ])('of %d are drawn as the package draws them', (size, samples, photoPixel) => {
    const found = samplingOf(size, 1000, 100, 1 << 24);
    expect(found.samples).toBe(samples);
    expect(found.photoPixel).toBeCloseTo(photoPixel, 8);
  });
  it('have no more samples than there is room for', () => {
    expect(samplingOf(0.05, 1 << 22, 6, 1 << 24)).toEqual({ samples: 2, photoPixel: 0.1 });
    expect(samplingOf(0.05, 1 << 24, 6, 1 << 24).samples).toBe(1);
  });
  it('are told by the points in the picture', () => {
    const view = new View(lookAt([0, 0, -4], [0, 0, 0], [0, -1, 0]), 60, 60, 30, 20, 60, 40);
    const points = (...rows: number[][]): Float32Array => Float32Array.from(rows.flat());
    expect(sizeOf(points([0, 0, 0, 15], [0.5, 0, 0, 15], [0, 0, -9, 1], [99, 0, 0, 1]), view)).toBeCloseTo(1);
    expect(sizeOf(points([0, 0, 0, 30]), view)).toBeCloseTo(0.5);
    expect(sizeOf(points([0, 0, -9, 1]), view)).toBe(1);
  });
  it('are drawn where surfels can be seen', () => {
    const view = new View(lookAt([0, 0, -8], [0, 0, 0], [0, -1, 0]), 60, 50, 60, 40, 120, 80);
    const surfels = (...rows: number[][]): Float32Array => {
      const words = new Float32Array(SURFEL_WORDS * rows.length);
      rows.forEach(([x, y, z, scale], i) => {
        words.set([x, y, z], SURFEL_WORDS * i + WORD.mean);
        words.set([Math.log(scale), -9], SURFEL_WORDS * i + WORD.logScale);
      });
      return words;
    };
    const [whole, none] = [
      [0, 0, 120, 80],
      [119, 79, 120, 80],
    ];
    expect(partOf(surfels([1, 0, 0, 0.1], [-1, 1, 0, 0.1], [0, 0, -99, 50]), view, 0.01)).toEqual([46, 35, 74, 52]);
    expect(partOf(surfels([1, 0, 0, 3]), view, 0.01)).toEqual(whole);
    expect(partOf(surfels([0, 0, -99, 1]), view, 0.01)).toEqual(none);
    expect(view.part(46, 35, 74, 52)).toMatchObject({ fx: 60, cx: 14, cy: 5, width: 28, height: 17 });
  });
});
