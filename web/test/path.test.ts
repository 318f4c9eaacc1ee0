import { describe, expect, it } from 'vitest';
import type { Vec3 } from '../src/bundle/manifest';
import { CameraPath } from '../src/view/path';
import { type Lens, type Pose, lookAt, rolled } from '../src/view/pose';
import { poseOf, quatOf } from '../src/view/rotation';
import { dot, length, subtract } from '../src/view/vector';

const LENS: Lens = { fx: 100, fy: 100, cx: 50, cy: 40, width: 100, height: 80 };
const around = (angle: number): Pose => lookAt([4 * Math.cos(angle), 4 * Math.sin(angle), 1], [0, 0, 0], [0, 0, 1]);

function path(poses: Pose[], seconds: number[], lenses: Lens[] = []): CameraPath {
  const made = new CameraPath();
  made.keyframes = poses.map((pose, k) => ({ pose, lens: lenses[k] ?? LENS, seconds: seconds[k] ?? 2 }));
  return made;
}
const apart = (a: Pose, b: Pose): number =>
  Math.max(...(['position', 'right', 'down', 'forward'] as const).map((key) => length(subtract(a[key], b[key]))));

describe('rotations', () => {
  it.each([0, 1, 2, 3])('are quaternions and back: %i', (k) => {
    const poses = [around(0.3), rolled(around(2), 3), lookAt([0, 3, 0], [0, 0, 0], [0, 0, -1]), around(-2.5)];
    expect(apart(poseOf(poses[k].position, quatOf(poses[k])), poses[k])).toBeLessThan(1e-9);
  });
});

describe('a path', () => {
  const poses = [around(0), around(0.8), rolled(around(1.5), 0.4), around(2.8)];
  it.each([true, false])('goes through its keyframes at their times; smooth: %s', (smooth) => {
    const made = path(poses, [1, 3, 0.5]);
    made.smooth = smooth;
    expect(made.seconds).toBe(4.5);
    [0, 1, 4, 4.5].forEach((time, k) => expect(apart(made.at(time, 100, 80).pose, poses[k])).toBeLessThan(1e-9));
    expect(apart(made.at(99, 100, 80).pose, poses[3])).toBeLessThan(1e-9);
  });
  it.each([false, true])('is smooth where its segments meet; loop: %s', (loop) => {
    const made = path(poses, [1, 3, 0.5, 2]);
    made.loop = loop;
    const e = 1e-4;
    const speed = (time: number, key: 'position' | 'forward'): Vec3 => {
      const [a, b] = [made.at(time - e, 100, 80).pose[key], made.at(time + e, 100, 80).pose[key]];
      return subtract(b, a).map((x) => x / (2 * e)) as Vec3;
    };
    for (const time of [1, 4, ...(loop ? [4.5] : [])]) {
      for (const key of ['position', 'forward'] as const) {
        expect(length(subtract(speed(time - 2 * e, key), speed(time + 2 * e, key)))).toBeLessThan(0.02);
      }
    }
    made.smooth = false;
    expect(length(subtract(speed(1 - 2 * e, 'position'), speed(1 + 2 * e, 'position')))).toBeGreaterThan(1);
    if (loop) expect(apart(made.at(made.seconds, 100, 80).pose, poses[0])).toBeLessThan(1e-9);
  });
  it('turns evenly between two keyframes, and stays where they are the same', () => {
    const level = (angle: number): Pose => lookAt([Math.cos(angle), Math.sin(angle), 0], [0, 0, 0], [0, 0, 1]);
    const made = path([level(0), level(2)], [2]);
    expect(Math.acos(dot(made.at(0.5, 100, 80).pose.forward, level(0).forward))).toBeCloseTo(0.5, 6);
    const paused = path([around(0), around(1), around(1), around(2)], [2, 2, 2]);
    expect(apart(paused.at(3.3, 100, 80).pose, around(1))).toBeLessThan(1e-9);
  });
  it('zooms by equal factors, and shows all of the lens', () => {
    const tele = { ...LENS, fx: 400, fy: 400 };
    const made = path([around(0), around(0.1)], [2], [LENS, tele]);
    expect([0, 1, 2].map((time) => made.at(time, 50, 40).fy)).toEqual([50, 100, 200].map((f) => expect.closeTo(f, 6)));
    const wide = made.at(0, 300, 80);
    expect([wide.fy, wide.cx, wide.cy]).toEqual([expect.closeTo(100, 6), 150, 40]);
  });
  it('is faster or slower as a whole', () => {
    const made = path(poses, [1, 3, 0.5]);
    made.seconds = 9;
    expect(made.keyframes.slice(0, 3).map(({ seconds }) => seconds)).toEqual([2, 6, 1]);
  });
});

describe('the file of a path', () => {
  it("has nerfstudio's fields, frames of equal distance, and OpenGL's axes", () => {
    const made = path([around(0), around(1)], [2]);
    const file = JSON.parse(made.file(640, 360));
    expect(Object.keys(file).sort()).toEqual(
      'camera_path camera_type crop fps is_cycle keyframes render_height render_width seconds smoothness_value'.split(
        ' ',
      ),
    );
    expect([file.render_width, file.render_height, file.fps, file.seconds]).toEqual([640, 360, 30, 2]);
    expect(file.camera_path).toHaveLength(60);
    const [first, last] = [file.camera_path[0], file.camera_path[59]];
    expect(first.aspect).toBeCloseTo(640 / 360);
    expect(first.fov).toBeCloseTo((360 / Math.PI) * Math.atan(180 / 450));
    const m: number[] = last.camera_to_world;
    const { position, right, down, forward } = around(1);
    [0, 1, 2].forEach((c) => {
      const row = [right[c], -down[c], -forward[c], position[c]];
      expect(m.slice(4 * c, 4 * c + 4)).toEqual(row.map((x) => expect.closeTo(x, 9)));
    });
    expect(m.slice(12)).toEqual([0, 0, 0, 1]);
  });
  it('has the principal points of the lenses', () => {
    const aside = { ...LENS, cx: 60, cy: 44 };
    const made = path([around(0), around(0)], [2], [aside, LENS]);
    expect(made.at(0, 200, 160).cx).toBeCloseTo(120);
    const points = JSON.parse(made.file(200, 160)).camera_path.map(
      (each: { principal_point: number[] }) => each.principal_point,
    );
    expect([points[0], points[59]]).toEqual([
      [expect.closeTo(0.6, 9), expect.closeTo(0.55, 9)],
      [0.5, 0.5].map((x) => expect.closeTo(x, 9)),
    ]);
  });
  it.each([true, false])('is taken back as it was; loop: %s', (loop) => {
    const poses = [around(0), rolled(around(0.8), 0.4), around(2)];
    const made = path(poses, [1, 3, 0.5], [{ ...LENS, cx: 60, fy: 120 }]);
    [made.loop, made.smooth] = [loop, !loop];
    const again = new CameraPath();
    again.load(made.file(640, 360));
    expect([again.loop, again.smooth, again.seconds]).toEqual([loop, !loop, made.seconds]);
    [0, 0.7, 2.2, 4].forEach((time) => {
      const [a, b] = [made, again].map((each) => each.at(time, 300, 200));
      expect(apart(a.pose, b.pose)).toBeLessThan(1e-9);
      expect([b.fx, b.fy, b.cx, b.cy]).toEqual([a.fx, a.fy, a.cx, a.cy].map((x) => expect.closeTo(x, 9)));
    });
  });
  it("of nerfstudio's viewer is taken, with the time of a keyframe before it", () => {
    const row = (angle: number, seconds: number | null): object => {
      const { position: p, right: r, down: d, forward: f } = around(angle);
      const matrix = [0, 1, 2].flatMap((c) => [r[c], -d[c], -f[c], p[c]]).concat(0, 0, 0, 1);
      const own = { override_transition_enabled: seconds !== null, override_transition_sec: seconds };
      return { matrix, fov: 90, aspect: 2, ...own };
    };
    const made = new CameraPath();
    const rest = { default_fov: 75, default_transition_sec: 1.5, camera_type: 'perspective', is_cycle: false };
    made.load(JSON.stringify({ keyframes: [row(0, 9), row(1, null), row(2, 4)], ...rest, smoothness_value: 0 }));
    expect([made.seconds, made.smooth]).toEqual([5.5, true]);
    expect(apart(made.at(1.5, 20, 10).pose, around(1))).toBeLessThan(1e-9);
    const { fy, cx, cy } = made.at(0, 20, 10);
    expect([fy, cx, cy]).toEqual([5, 10, 5].map((x) => expect.closeTo(x, 9)));
  });
  it.each([
    [/JSON/, '{'],
    [/keyframes/, 'null'],
    [/keyframes/, '{"camera_path": []}'],
    [/keyframes/, '{"keyframes": []}'],
    [/perspective/, '{"keyframes": [{}], "camera_type": "fisheye"}'],
    [/keyframe 1 /, '{"keyframes": [null]}'],
    [
      /keyframe 1 /,
      '{"keyframes": [{"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 200, "aspect": 1}]}',
    ],
    [
      /keyframe 1 /,
      '{"keyframes": [{"matrix": [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 50, "aspect": 1}]}',
    ],
  ])('is refused: %s %s', (words, text) => {
    const made = path([around(0)], [2]);
    expect(() => made.load(text)).toThrowError(words);
    expect(made.keyframes).toHaveLength(1);
  });
  it('of a loop ends before it begins again', () => {
    const made = path([around(0), around(1)], [2, 2]);
    made.loop = true;
    const file = JSON.parse(made.file(64, 48));
    expect([file.is_cycle, file.camera_path.length]).toEqual([true, 120]);
    expect(file.camera_path[119].camera_to_world).not.toEqual(file.camera_path[0].camera_to_world);
    expect(file.camera_path[60].camera_to_world[3]).toBeCloseTo(4 * Math.cos(1));
  });
});
