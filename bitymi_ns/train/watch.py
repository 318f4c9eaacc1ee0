"""Notices a loss that is not finite, without making a step wait for its numbers."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns.train.errors import TrainingDiverged, describe_broken

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


class LossWatch:
    """Notices a loss that is not finite.

    On a CUDA device the host does not wait for the numbers: they are looked at when they have arrived, a few steps
    later.
    """

    def __init__(self) -> None:
        self._underway: deque[tuple[int, tuple[str, ...], Tensor, torch.cuda.Event]] = deque()

    def note(self, scene: Scene, step: int, terms: dict[str, Tensor]) -> None:
        """Take in the terms of a step's loss.

        Raises:
            TrainingDiverged: a term of this step, or of an earlier one, is not finite.
        """
        names, values = tuple(terms), torch.stack([term.detach() for term in terms.values()])
        if values.device.type != "cuda":
            self._check(scene, step, names, values)
            return
        arrived = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
        arrived.copy_(values, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(values.device))
        self._underway.append((step, names, arrived, event))
        while self._underway and self._underway[0][3].query():
            self._check(scene, *self._underway.popleft()[:3])

    def finish(self, scene: Scene) -> None:
        """Wait for all that is underway; raises what `note` raises."""
        while self._underway:
            self._underway[0][3].synchronize()
            self._check(scene, *self._underway.popleft()[:3])

    def forget(self) -> None:
        """Look at nothing that is underway: the run has gone back to before it."""
        self._underway.clear()

    @staticmethod
    def _check(scene: Scene, step: int, names: tuple[str, ...], values: Tensor) -> None:
        for name, value in zip(names, values.tolist(), strict=True):
            if not math.isfinite(value):
                cause = describe_broken(scene) or "all parameters are finite; look for NaN in the images and cameras"
                raise TrainingDiverged(f"the {name} loss is {value} at step {step}: {cause}")
