"""What can go wrong in training beyond repair."""

from __future__ import annotations

import torch
from torch import nn


class TrainingDiverged(ValueError):
    """The loss or every surfel is no longer finite."""


def describe_broken(module: nn.Module) -> str:
    """Name the first parameter that is not finite, and its row; empty when all are finite."""
    for name, parameter in module.named_parameters():
        if len(parameter) == 0:
            continue
        broken = ~torch.isfinite(parameter.detach().reshape(len(parameter), -1)).all(-1)
        if bool(broken.any()):
            rows = broken.nonzero().flatten()
            return f"{name} is not finite in {len(rows)} of {len(parameter)} rows, the first is row {int(rows[0])}"
    return ""
