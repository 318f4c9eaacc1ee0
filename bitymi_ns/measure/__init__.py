"""Measuring: benchmarks and reports, stability, pictures of a run. Nothing of the method needs it."""
