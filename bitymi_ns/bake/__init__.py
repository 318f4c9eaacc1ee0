"""Trained scene to bundle contents: tiles, view colours, fine-tuning, coding; the paper's bake is in `field`."""

from bitymi_ns.bake.baked import Baked, export
from bitymi_ns.bake.field.bake import bake
from bitymi_ns.bake.field.polish import PolishOptions, polish_scene
from bitymi_ns.bake.pipeline import Learning, bake_and_learn, reduced
from bitymi_ns.bake.tune import TuneOptions, tune_atlas
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.progress import rich_progress

__all__ = [
    "BakeOptions",
    "Baked",
    "Learning",
    "PolishOptions",
    "TuneOptions",
    "bake",
    "bake_and_learn",
    "export",
    "polish_scene",
    "reduced",
    "rich_progress",
    "tune_atlas",
]
