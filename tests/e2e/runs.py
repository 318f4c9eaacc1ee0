"""Checkpoints and configurations of finished runs."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml

from bitymi_ns.plugin.run.config import BitymiTrainerConfig

Start = Callable[..., BitymiTrainerConfig]


def checkpoint(config: BitymiTrainerConfig, step: int) -> dict[str, Any]:
    return torch.load(config.get_checkpoint_dir() / f"step-{step:09d}.ckpt", weights_only=True)


def a_run_of(trained: BitymiTrainerConfig, folder: Path) -> Path:
    return Path(shutil.copytree(trained.get_base_dir(), folder / "run"))


def config_of(folder: Path) -> BitymiTrainerConfig:
    return yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)


def rewrite(folder: Path, change: Callable[[BitymiTrainerConfig], None]) -> None:
    config = config_of(folder)
    change(config)
    (folder / "config.yml").write_text(yaml.dump(config))


def different(a: Any, b: Any, path: str = "") -> list[str]:
    """List the differences of two checkpoints, except clocks."""
    if path.endswith("seconds"):
        return []
    if isinstance(a, torch.Tensor):
        return [] if torch.equal(a, b) else [path]
    if isinstance(a, dict):
        if a.keys() != b.keys():
            return [path]
        return [d for key in a for d in different(a[key], b[key], f"{path}/{key}")]
    if isinstance(a, (list, tuple)):
        return [d for i, pair in enumerate(zip(a, b, strict=True)) for d in different(*pair, f"{path}/{i}")]
    return [] if a == b else [path]
