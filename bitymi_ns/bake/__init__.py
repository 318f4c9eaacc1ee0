"""Trained scene to bundle contents: tiles, view colours, fine-tuning, coding; `field`: of the paper's field."""

from bitymi_ns.bake.field.train_texels import PolishOptions, polish_scene
from bitymi_ns.bake.pipeline import RefineOptions, bake, bake_field
from bitymi_ns.bake.prune import prune_and_resample
from bitymi_ns.bake.stages import Coded, Reduced, Rounded, Stage, Trained, export
from bitymi_ns.bake.tune import TuneOptions, tune_atlas
from bitymi_ns.bundle.bake_options import BakeOptions

__all__ = [
    "BakeOptions",
    "Coded",
    "Reduced",
    "RefineOptions",
    "Rounded",
    "Stage",
    "Trained",
    "PolishOptions",
    "TuneOptions",
    "bake_field",
    "bake",
    "export",
    "polish_scene",
    "prune_and_resample",
    "tune_atlas",
]
