// The share of the screen's resolution that holds 60 frames a second while the camera moves.
const WANTED = 1000 / 60;
const LEAST = 0.2;

export class Pace {
  scale = 1;
  milliseconds = 0; // of a frame, smoothed

  // After a frame that took so long at the present scale.
  took(milliseconds: number): void {
    this.milliseconds = this.milliseconds ? 0.7 * this.milliseconds + 0.3 * milliseconds : milliseconds;
    const wish = this.scale * Math.sqrt((0.85 * WANTED) / Math.max(this.milliseconds, 0.5));
    const next = Math.min(1, Math.max(LEAST, wish));
    // small steps, and none for small differences: each asks for new targets
    if (Math.abs(next - this.scale) > 0.08 * this.scale) {
      const step = 0.5 * (next - this.scale);
      this.scale += Math.sign(step) * Math.max(Math.abs(step), Math.min(0.05, Math.abs(2 * step)));
      this.milliseconds = 0;
    }
  }
}
