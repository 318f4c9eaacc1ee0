"""Trained scene to bundle contents: tiles, view colours, fine-tuning, coding; `field`: of the paper's field."""

from bitymi_ns.bundle.bake_options import BakeOptions
from .field.train_texels import PolishOptions, polish_scene
from .pipeline import RefineOptions, bake, bake_field
from .prune import prune_and_resample
from .stages import Coded, Reduced, Rounded, Stage, Trained, export
from .tune import TuneOptions, tune_atlas

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
