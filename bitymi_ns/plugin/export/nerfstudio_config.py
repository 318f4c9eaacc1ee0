"""config.yml of a bundle, with which nerfstudio's tools open it."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from bitymi_ns.bundle.parts import CONFIG as CONFIG
from bitymi_ns.plugin.run.bundle_model import BakedModelConfig
from bitymi_ns.plugin.run.config import method_config


def bundle_config(config: Any, folder: Path, background: Sequence[float]) -> bytes:
    """The config.yml with which nerfstudio's tools open the bundle.

    It is no part of what bundle.json vouches for: nothing of ours reads it, and its data path may have to be edited
    when the photographs are moved.
    """
    config = copy.deepcopy(config)
    config.pipeline.model = BakedModelConfig(bundle=folder.absolute(), background=tuple(background))  # type: ignore[arg-type]
    config.load_dir = config.load_step = config.load_checkpoint = config.load_config = None
    config.optimizers = {}
    vars(config).pop("read_from", None)
    return yaml.dump(config).encode("utf8")


def config_without_run(folder: Path, background: Sequence[float]) -> bytes:
    """Make the config.yml of a bundle whose run is not at hand. Its capture is not there either, so that its own
    cameras are used; `BITYMI_DATA` names one."""
    config = method_config("bitymi").config
    config.experiment_name = folder.name
    config.pipeline.datamanager.data = folder.absolute() / "photographs"
    return bundle_config(config, folder, background)
