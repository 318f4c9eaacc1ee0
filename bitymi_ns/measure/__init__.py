"""Benchmarks, reports, numerical stability, and images of a run; the method does not depend on this package."""
