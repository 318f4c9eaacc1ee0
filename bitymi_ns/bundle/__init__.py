"""Bundles, the folders of baked scenes (surfels, atlas, description): writing, reading, checking."""

from .manifest import BundleError
from .parts import reserved_bundle
from .read import REMEDY, Bundle, read_bundle
from .verify import Check, check_files, check_world
from .world import World
from .write import write_bundle

__all__ = [
    "REMEDY",
    "Bundle",
    "BundleError",
    "Check",
    "World",
    "check_files",
    "check_world",
    "read_bundle",
    "reserved_bundle",
    "write_bundle",
]
