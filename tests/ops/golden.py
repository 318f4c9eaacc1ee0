"""The golden renders; the scenes that they and other tests share are in bitymi_ns.stability."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.stability.scenes import SURFEL_KEYS, SV_KEYS, SceneCase, extreme_scenes, random_scene

__all__ = [
    "GOLDEN_NAMES",
    "SURFEL_KEYS",
    "SV_KEYS",
    "Golden",
    "SceneCase",
    "extreme_scenes",
    "load_golden",
    "random_scene",
]

GOLDEN = Path(__file__).resolve().parent.parent / "golden"
GOLDEN_NAMES = sorted(path.stem for path in GOLDEN.glob("*.npz"))


@dataclass
class Golden(SceneCase):
    """A golden render: the case, its images, and the gradients of loss = sum of loss_weights[k] * outputs[k]."""

    outputs: dict[str, Tensor] = field(default_factory=dict)  # rgb, alpha, depth, beta_map, overdraw
    loss_weights: dict[str, Tensor] = field(default_factory=dict)  # rgb, alpha, depth, beta_map
    loss: float = 0.0
    grads: dict[str, Tensor] = field(default_factory=dict)  # as params
    tile_grads: list[Tensor] | None = None


def load_golden(name: str) -> Golden:
    """One of GOLDEN_NAMES, from tests/golden (conventions: the README there)."""
    with np.load(GOLDEN / f"{name}.npz") as file:
        data = {key: torch.from_numpy(file[key]) for key in file.files}

    def group(prefix: str) -> dict[str, Tensor]:
        return {key[len(prefix) :]: value for key, value in data.items() if key.startswith(prefix)}

    def split(values: dict[str, Tensor]) -> tuple[dict[str, Tensor], list[Tensor] | None]:
        tiles = [values[key] for key in sorted(values) if key.startswith("tile_")]
        return {key: value for key, value in values.items() if not key.startswith("tile_")}, tiles or None

    params, tiles = split(group("in_"))
    grads, tile_grads = split(group("grad_"))
    return Golden(
        name=name,
        params=params,
        viewmat=data["cam_viewmat"],
        K=data["cam_K"],
        width=int(data["cam_width"]),
        height=int(data["cam_height"]),
        background=data["cam_background"],
        tiles=tiles,
        outputs=group("out_"),
        loss_weights=group("lossweight_"),
        loss=float(data["loss"]),
        grads=grads,
        tile_grads=tile_grads,
    )
