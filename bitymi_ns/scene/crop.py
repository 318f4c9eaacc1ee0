"""Crops of a scene: surfels are kept or hidden by their centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.ops.reference.project import rotation

Vector = tuple[float, ...]  # three numbers


def _tensor(numbers: Sequence[float] | Sequence[Sequence[float]]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


@dataclass(frozen=True)
class Box:
    """Oriented box, faces included."""

    center: Vector
    half: Vector  # half sides along the axes
    axes: tuple[Vector, ...]  # rows of a rotation matrix, whose columns are the axes

    @classmethod
    def rotated(cls, center: Sequence[float], half: Sequence[float], quat: Sequence[float]) -> Box:
        """Make a box with the axes of a rotation wxyz, of any length but zero."""
        return cls.of(center, half, rotation(_tensor([quat]))[0].tolist())

    @classmethod
    def of(cls, center: Sequence[float], half: Sequence[float], axes: Sequence[Sequence[float]]) -> Box:
        return cls(tuple(center), tuple(half), tuple(map(tuple, axes)))

    def contains(self, points: Tensor) -> Tensor:
        """Tell which of the points [N, 3] lie in the box, [N] bool."""
        center, half, axes = (_tensor(numbers).to(points.device) for numbers in (self.center, self.half, self.axes))
        return (((points.double() - center) @ axes).abs() <= half).all(-1)


@dataclass(frozen=True)
class Crop:
    """Crop of a scene.

    Attributes:
        box: surfels outside are hidden; None: no box.
        floor: normal and offset of a plane; surfels with normal . mean < offset are hidden.
        hidden: surfels in these boxes are hidden.
    """

    box: Box | None = None
    floor: tuple[Vector, float] | None = None
    hidden: tuple[Box, ...] = ()

    def keeps(self, means: Tensor) -> Tensor:
        """Tell which surfels of centres [N, 3] are shown, [N] bool."""
        kept = torch.ones(len(means), dtype=torch.bool, device=means.device)
        if self.box is not None:
            kept &= self.box.contains(means)
        if self.floor is not None:
            normal, offset = self.floor
            kept &= means.double() @ _tensor(normal).to(means.device) >= offset
        for box in self.hidden:
            kept &= ~box.contains(means)
        return kept
