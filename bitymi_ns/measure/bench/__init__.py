"""Benchmarks: train, bake and evaluate a matrix of scenes, methods and seeds with nerfstudio's commands."""
