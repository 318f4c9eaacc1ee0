"""What can go wrong in training beyond repair."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


class TrainingDiverged(ValueError):
    """The loss or every surfel is no longer finite."""


def describe_broken(scene: Scene) -> str:
    """Name the first parameter that is not finite, and its row; empty when all are finite."""
    for name, parameter in scene.named_parameters():
        broken = ~torch.isfinite(parameter.detach().reshape(len(parameter), -1)).all(-1)
        if bool(broken.any()):
            rows = broken.nonzero().flatten()
            return f"{name} is not finite in {len(rows)} of {len(parameter)} rows, the first is row {int(rows[0])}"
    return ""
