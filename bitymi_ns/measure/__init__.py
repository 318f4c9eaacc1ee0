"""Measuring: benchmarks and reports, stability, quality knobs, pictures of a run. Nothing of the method needs it."""
