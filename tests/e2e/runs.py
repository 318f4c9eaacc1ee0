"""Runs that are finished: their checkpoints and configurations."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml

from bitymi_ns.host.config import BitymiTrainerConfig

Start = Callable[..., BitymiTrainerConfig]


def checkpoint(config: BitymiTrainerConfig, step: int) -> dict[str, Any]:
    return torch.load(config.get_checkpoint_dir() / f"step-{step:09d}.ckpt", weights_only=True)


def a_run_of(trained: BitymiTrainerConfig, folder: Path) -> Path:
    """A copy of the run, in another place: its folder."""
    return Path(shutil.copytree(trained.get_base_dir(), folder / "run"))


def rewrite(folder: Path, change: Callable[[BitymiTrainerConfig], None]) -> None:
    """Apply `change` to the config.yml of a run."""
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    change(config)
    (folder / "config.yml").write_text(yaml.dump(config))
