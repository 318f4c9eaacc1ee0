// Decodes compact bundles in a worker, to keep the page responsive; it is terminated after a timeout.
import { DamagedBundle, ViewerError } from '../../errors';
import type { Pages } from '../ktx2';
import type { Atlas, Manifest } from '../manifest';
import type { Surfels } from '../surfels';
import type { Answer, Job } from './worker';

const LONGEST = 60_000; // milliseconds

export class Decoder {
  private readonly worker = new Worker(new URL('./worker.ts', import.meta.url), { type: 'module' });

  private ask<T extends Surfels | Pages>(job: Job, data: ArrayBuffer): Promise<T> {
    return new Promise((resolve, reject) => {
      const end = setTimeout(() => {
        this.end();
        reject(new DamagedBundle(`${job.what}.bin cannot be decoded in ${LONGEST / 1000} seconds.`));
      }, LONGEST);
      this.worker.onmessage = ({ data: answer }: MessageEvent<Answer>) => {
        clearTimeout(end);
        if (answer.made) resolve(answer.made as T);
        else reject(new ViewerError(answer.title, answer.detail, answer.advice));
      };
      this.worker.onerror = (event) => {
        clearTimeout(end);
        reject(new Error(`The decoder stopped: ${event.message || 'its script cannot be loaded'}`));
      };
      this.worker.postMessage(job, [data]);
    });
  }

  // Decodes surfels.bin; transfers `data`.
  async surfels(data: ArrayBuffer, info: Manifest): Promise<Surfels> {
    return this.ask({ what: 'surfels', data, info }, data);
  }

  // Decodes texels.bin to pages; the last request.
  async texels(data: ArrayBuffer, atlas: Atlas, surfels: Surfels): Promise<Pages> {
    try {
      return await this.ask({ what: 'texels', data, atlas, surfels: { ...surfels, terms: new Float32Array() } }, data);
    } finally {
      this.end();
    }
  }

  end(): void {
    this.worker.terminate();
  }
}
