"""Benchmarks: a matrix of scenes, methods and seeds, trained, baked and evaluated by nerfstudio's commands."""

from bitymi_ns.measure.bench.cells import Cells
from bitymi_ns.measure.bench.engine import open_cells, run_chains
from bitymi_ns.measure.bench.matrix import Bundle, Matrix, Row, Run, SceneSpec, Stage
from bitymi_ns.measure.bench.process import BenchError, CommandFailed

__all__ = [
    "BenchError",
    "Bundle",
    "Cells",
    "CommandFailed",
    "Matrix",
    "Row",
    "Run",
    "SceneSpec",
    "Stage",
    "open_cells",
    "run_chains",
]
