"""Trained field to texture atlas: resolution, plan, evaluation, reduction, packing, quantisation, fine-tuning."""

from bitymi_ns.bake.options import BakeOptions
from bitymi_ns.bake.pipeline import Baked, bake
from bitymi_ns.bake.tune import TuneOptions, tune_atlas
from bitymi_ns.progress import Progress, rich_progress

__all__ = ["BakeOptions", "Baked", "Progress", "TuneOptions", "bake", "rich_progress", "tune_atlas"]
