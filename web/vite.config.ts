import { defineConfig } from 'vitest/config';

// Files have fixed names, so that a build changes what it has to; the service sends them with no-cache and an ETag.
export default defineConfig({
  base: './',
  // pages that are opened as files then have their style, and can say that they must not be
  plugins: [{ name: 'plain-links', transformIndexHtml: (html) => html.replaceAll(' crossorigin', '') }],
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
