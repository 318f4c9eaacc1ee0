// Worker of decoder.ts.
import { reasonOf } from '../../errors';
import type { Pages } from '../ktx2';
import type { Atlas, Manifest } from '../manifest';
import type { Surfels } from '../surfels';
import { readCompactSurfels } from './surfels';
import { readCompactTexels } from './texels';

export type Job =
  | { what: 'surfels'; data: ArrayBuffer; info: Manifest }
  | { what: 'texels'; data: ArrayBuffer; atlas: Atlas; surfels: Surfels };

export type Answer = { made: Surfels | Pages } | { made: null; title: string; detail: string; advice: string };

function answer(made: Surfels | Pages, memory: Iterable<Float32Array | Uint8Array>): void {
  postMessage({ made }, { transfer: [...memory].map((array) => array.buffer as ArrayBuffer) });
}

function run(job: Job): void {
  const data = new Uint8Array(job.data);
  if (job.what === 'surfels') {
    const surfels = readCompactSurfels(data, job.info);
    answer(surfels, [surfels.words, surfels.terms]);
  } else {
    const pages = readCompactTexels(data, job.atlas, job.surfels);
    answer(pages, pages.layers);
  }
}

addEventListener('message', ({ data: job }: MessageEvent<Job>) => {
  try {
    run(job);
  } catch (error) {
    const { title, message, advice } = reasonOf(error);
    postMessage({ made: null, title, detail: message, advice } satisfies Answer);
  }
});
