"""Trained field to texture atlas: resolution, packing, evaluation, quantisation and the files of a bundle."""

from bitymi_ns.bake.bundle import Bundle, BundleError, World, check_target, read_bundle, verify_bundle, write_bundle
from bitymi_ns.bake.bundle_reader import REMEDY
from bitymi_ns.bake.options import BakeOptions
from bitymi_ns.bake.pipeline import Baked, bake, export
from bitymi_ns.bake.progress import Progress, rich_progress
from bitymi_ns.bake.tune import TuneOptions, tune_atlas
from bitymi_ns.bake.verify import Check, check_field, check_files, check_view_color

__all__ = [
    "REMEDY",
    "BakeOptions",
    "Baked",
    "Bundle",
    "BundleError",
    "Check",
    "Progress",
    "TuneOptions",
    "World",
    "bake",
    "check_field",
    "check_files",
    "check_target",
    "check_view_color",
    "export",
    "read_bundle",
    "rich_progress",
    "tune_atlas",
    "verify_bundle",
    "write_bundle",
]
