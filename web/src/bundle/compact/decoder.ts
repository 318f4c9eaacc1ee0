// Decodes compact bundles in workers, to keep the page responsive. Sizes alone bound the time.
import { ViewerError } from '../../errors';
import type { Pages } from '../ktx2';
import type { Atlas, Manifest } from '../manifest';
import type { Surfels } from '../surfels';
import type { Answer, Job } from './worker';

const LONG = 20_000; // milliseconds, after which a line says that it goes on

export type Say = (line: string) => void;

async function decoded<T extends Surfels | Pages>(job: Job, say: Say): Promise<T> {
  const worker = new Worker(new URL('./worker.ts', import.meta.url), { type: 'module' });
  const line = setTimeout(() => say(`${job.what}.bin is still being decoded.`), LONG);
  try {
    return await new Promise<T>((resolve, reject) => {
      worker.onmessage = ({ data: answer }: MessageEvent<Answer>) => {
        if (answer.made) resolve(answer.made as T);
        else reject(new ViewerError(answer.title, answer.detail, answer.advice));
      };
      worker.onerror = (event) => {
        reject(new Error(`The decoder stopped: ${event.message || 'its script cannot be loaded'}`));
      };
      worker.postMessage(job, [job.data]);
    });
  } finally {
    clearTimeout(line);
    worker.terminate();
  }
}

// Decodes surfels.bin; transfers `data`.
export const decodeSurfels = (data: ArrayBuffer, info: Manifest, say: Say): Promise<Surfels> =>
  decoded({ what: 'surfels', data, info }, say);

// Decodes texels.bin to pages; transfers `data`.
export const decodeTexels = (data: ArrayBuffer, atlas: Atlas, surfels: Surfels, say: Say): Promise<Pages> =>
  decoded({ what: 'texels', data, atlas, surfels: { ...surfels, terms: new Float32Array() } }, say);
