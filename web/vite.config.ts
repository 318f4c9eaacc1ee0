import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { defineConfig } from 'vitest/config';

// Puts start.js into the page, which its policy admits by its hash, and leaves links plain: pages that are opened as
// files then have their style, and can say that they must not be.
function page(html: string): string {
  const start = `\n${readFileSync(new URL('src/start.js', import.meta.url), 'utf8')}`;
  const hash = createHash('sha256').update(start).digest('base64');
  return html
    .replaceAll(' crossorigin', '')
    .replace('sha256-start', `sha256-${hash}`)
    .replace('<!-- start.js -->', () => `<script>${start}</script>`);
}

// Files have fixed names, so that a build changes what it has to; the service sends them with no-cache and an ETag.
export default defineConfig({
  base: './',
  plugins: [{ name: 'page', transformIndexHtml: page }],
  build: {
    outDir: '../bitymi_ns/view/page',
    emptyOutDir: true,
    target: 'es2022',
    modulePreload: false,
    rollupOptions: {
      output: {
        entryFileNames: '[name].js',
        chunkFileNames: '[name].js',
        assetFileNames: '[name].[ext]',
      },
    },
  },
  worker: { format: 'es', rollupOptions: { output: { entryFileNames: '[name].js' } } },
  server: { fs: { allow: ['..'] } },
  test: { include: ['test/**/*.test.ts'] },
});
