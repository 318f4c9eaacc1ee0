"""Output folder of an export: checks before the work, and config.yml for nerfstudio's tools."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.manifest import MANIFEST, Manifest
from bitymi_ns.codec.quantise import BYTES_PER_TEXEL
from bitymi_ns.files import free_bytes, size_text
from ..console import fail
from ..run.bundle_model import BakedModelConfig
from ..run.config import method_config

SURFEL_BYTES = 60 * 4  # of parameters; checkpoints have them and Adam's two moments
TYPICAL_SIDE = 32  # side of a tile in texels; most are far smaller


def check_room(folder: Path, load_config: Path, options: BakeOptions, exact: bool) -> None:
    needed, free = space_needed(load_config, options, exact), free_bytes(folder)
    if free < needed:
        fail(
            f"{folder} may take up to {size_text(needed)}, by a generous estimate, and {size_text(free)} are free: "
            "free more, give an --output-dir on another disk, or try --check-room False."
        )


def space_needed(load_config: Path, options: BakeOptions, exact: bool) -> int:
    """Estimate the most bytes of a run's bundle by its newest checkpoint, taken to hold surfels alone, each with a tile
    of TYPICAL_SIDE texels per side, or of the largest if `exact`; 0 without a checkpoint."""
    newest = max(load_config.parent.glob("*/step-*.ckpt"), default=None)
    surfels = newest.stat().st_size // (3 * SURFEL_BYTES) if newest is not None else 0
    side = options.r_max if exact else min(options.r_max, TYPICAL_SIDE)
    texel = 1 if options.bundle_format == "compact" else BYTES_PER_TEXEL[options.texel_format]
    return surfels * (SURFEL_BYTES + side * side * texel)


def bundle_version(folder: Path) -> tuple[int, int] | None:
    """Return inode and time of a folder's bundle file; None without one."""
    try:
        status = (folder / MANIFEST).stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def bundle_config(config: Any, folder: Path, background: Sequence[float]) -> bytes:
    """Make the config.yml with which nerfstudio's tools open a bundle. bundle.json has no hash of it, as its data path
    may have to be edited."""
    config = copy.deepcopy(config)
    red, green, blue = background
    config.pipeline.model = BakedModelConfig(bundle=folder.absolute(), background=(red, green, blue))
    config.load_dir = config.load_step = config.load_checkpoint = config.load_config = None
    config.optimizers = {}
    vars(config).pop("read_from", None)
    return yaml.dump(config).encode("utf8")


def config_without_run(folder: Path, info: Manifest) -> bytes:
    """Make the config.yml of a bundle without run, which uses its own cameras; a capture named by `BITYMI_DATA` is read
    in the frame of its files if that is the bundle's."""
    config: Any = method_config("bitymi").config
    config.experiment_name = folder.name
    config.pipeline.datamanager.data = folder.absolute() / "photographs"
    if info.world is None or (np.array_equal(info.world.transform, np.eye(4)[:3]) and info.world.scale == 1):
        own = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
        vars(config.pipeline.datamanager.dataparser).update(own)
    return bundle_config(config, folder, info.render.background)
