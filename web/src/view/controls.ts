// Camera control by mouse, touch and keys.
import type { Vec3 } from '../bundle/manifest';
import { typing } from '../ui/dom';
import { type Pose, look, moved, orbit, rolled } from './pose';
import { add, length, subtract } from './vector';

const TAP = 50; // milliseconds that a key counts as held at least

export type Mode = 'orbit' | 'fly';

export class Controls {
  mode: Mode = 'orbit';
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private readonly held = new Set<string>();
  private last = 0;

  constructor(
    private readonly surface: HTMLElement,
    public pose: Pose,
    public target: Vec3,
    private readonly up: Vec3,
    private readonly size: number, // of the scene, the unit of steps
    private readonly changed: () => void,
  ) {
    surface.addEventListener('pointerdown', (e) => {
      surface.setPointerCapture(e.pointerId);
      this.pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    });
    for (const end of ['pointerup', 'pointercancel'] as const) {
      surface.addEventListener(end, (e) => this.pointers.delete(e.pointerId));
    }
    surface.addEventListener('pointermove', (e) => this.drag(e));
    surface.addEventListener('contextmenu', (e) => e.preventDefault());
    surface.addEventListener(
      'wheel',
      (e) => {
        e.preventDefault();
        this.approach(Math.exp(-e.deltaY * (e.deltaMode === 1 ? 0.05 : 0.0015)));
      },
      { passive: false },
    );
    addEventListener('keydown', (e) => {
      if (typing(e.target) || e.ctrlKey || e.metaKey || e.altKey || !MOVES[e.code]) return;
      e.preventDefault();
      if (this.held.has(e.code)) return;
      this.held.add(e.code);
      // a key released before the next frame also moves the camera
      this.last = e.timeStamp - TAP;
      this.advance(e.timeStamp);
    });
    addEventListener('keyup', (e) => this.held.delete(e.code));
    addEventListener('blur', () => this.held.clear());
  }

  private distance(): number {
    return Math.max(length(subtract(this.target, this.pose.position)), 1e-3 * this.size);
  }

  private drag(e: PointerEvent): void {
    const before = this.pointers.get(e.pointerId);
    if (!before) return;
    const [dx, dy] = [e.clientX - before.x, e.clientY - before.y];
    const others = [...this.pointers].filter(([id]) => id !== e.pointerId).map(([, at]) => at);
    this.pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    const side = Math.min(this.surface.clientWidth, this.surface.clientHeight);
    if (others.length === 1) {
      const apart = (p: { x: number; y: number }): number => Math.hypot(p.x - others[0].x, p.y - others[0].y);
      this.slide(dx / 2 / side, dy / 2 / side);
      this.approach(apart({ x: e.clientX, y: e.clientY }) / Math.max(apart(before), 1));
    } else if (e.buttons & 6 || e.shiftKey) {
      this.slide(dx / side, dy / side);
    } else {
      this.turn((dx / side) * 3, (dy / side) * 3);
    }
  }

  // Turns by angles as if dragging the scene: in orbit, points nearer than the target follow the pointer.
  private turn(across: number, downwards: number): void {
    if (this.mode === 'orbit') {
      this.pose = orbit(this.pose, this.target, this.up, across, -downwards);
    } else {
      this.lookBy(-across / 2, -downwards / 2);
    }
    this.changed();
  }

  private lookBy(across: number, downwards: number): void {
    const away = this.distance();
    this.pose = look(this.pose, this.up, across, -downwards);
    this.target = moved(this.pose, 0, 0, away).position;
  }

  // Pans, by fractions of the screen's shorter side.
  private slide(across: number, downwards: number): void {
    const k = this.mode === 'orbit' ? this.distance() : this.size;
    this.step(-across * k, -downwards * k, 0);
  }

  private approach(factor: number): void {
    const away = this.distance();
    if (this.mode === 'orbit') this.pose = moved(this.pose, 0, 0, away - away / factor);
    else this.step(0, 0, Math.log(factor) * 0.5 * this.size);
    this.changed();
  }

  private step(right: number, down: number, forward: number): void {
    const before = this.pose.position;
    this.pose = moved(this.pose, right, down, forward);
    this.target = add(this.target, subtract(this.pose.position, before));
    this.changed();
  }

  // Moves by the held keys; returns whether any is held.
  advance(now: number): boolean {
    // a frame may have begun before its key was pressed
    const seconds = Math.min(0.1, Math.max(0, now - this.last) / 1000);
    this.last = Math.max(now, this.last);
    if (!this.held.size) return false;
    const fast = this.held.has('ShiftLeft') || this.held.has('ShiftRight') ? 4 : 1;
    for (const code of this.held) {
      const [right, down, forward, across, upwards, roll] = MOVES[code];
      const k = 0.35 * this.size * seconds * fast;
      if (right || down || forward) this.step(right * k, down * k, forward * k);
      if (across || upwards) this.lookBy(across * seconds, -upwards * seconds);
      if (roll) this.pose = rolled(this.pose, roll * seconds);
    }
    this.changed();
    return true;
  }
}

// right, down, forward; turn right, turn up, roll
const MOVES: Record<string, [number, number, number, number, number, number]> = {
  KeyW: [0, 0, 1, 0, 0, 0],
  KeyS: [0, 0, -1, 0, 0, 0],
  KeyA: [-1, 0, 0, 0, 0, 0],
  KeyD: [1, 0, 0, 0, 0, 0],
  KeyQ: [0, 1, 0, 0, 0, 0],
  KeyE: [0, -1, 0, 0, 0, 0],
  ArrowLeft: [0, 0, 0, -1, 0, 0],
  ArrowRight: [0, 0, 0, 1, 0, 0],
  ArrowUp: [0, 0, 0, 0, 1, 0],
  ArrowDown: [0, 0, 0, 0, -1, 0],
  KeyZ: [0, 0, 0, 0, 0, -1],
  KeyX: [0, 0, 0, 0, 0, 1],
  ShiftLeft: [0, 0, 0, 0, 0, 0],
  ShiftRight: [0, 0, 0, 0, 0, 0],
};
