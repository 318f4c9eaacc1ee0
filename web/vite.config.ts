import { defineConfig } from 'vitest/config';

// Files have fixed names, so that a build changes what it has to; the service sends them with no-cache and an ETag.
export default defineConfig({
  base: './',
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
