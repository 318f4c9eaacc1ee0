"""Bundles, the folders of baked scenes (surfels, atlas, description): writing, reading, checking."""

from bitymi_ns.bundle.manifest import BundleError
from bitymi_ns.bundle.parts import reserved_bundle
from bitymi_ns.bundle.read import REMEDY, Bundle, read_bundle
from bitymi_ns.bundle.verify import Check, check_files, check_world
from bitymi_ns.bundle.world import World
from bitymi_ns.bundle.write import write_bundle

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
