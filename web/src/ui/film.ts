// Real-time recording of a canvas.
const TYPE = 'video/webm';
const BITS = 16e6; // per second
const SETTLING = 100; // milliseconds

export const filmable = (): boolean =>
  typeof MediaRecorder !== 'undefined' &&
  'captureStream' in HTMLCanvasElement.prototype &&
  MediaRecorder.isTypeSupported(TYPE);

export class Film {
  private readonly parts: Blob[] = [];
  private readonly recorder: MediaRecorder;

  constructor(canvas: HTMLCanvasElement) {
    this.recorder = new MediaRecorder(canvas.captureStream(), { mimeType: TYPE, videoBitsPerSecond: BITS });
    this.recorder.ondataavailable = ({ data }) => this.parts.push(data);
    this.recorder.start();
  }

  end(): Promise<Blob> {
    return new Promise((give) => {
      this.recorder.onstop = () => give(new Blob(this.parts, { type: TYPE }));
      // the last frame is still being encoded
      setTimeout(() => {
        this.recorder.stop();
        for (const track of this.recorder.stream.getTracks()) track.stop();
      }, SETTLING);
    });
  }
}
