"""Detection of losses that are not finite, without synchronising the GPU in every step."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene

TOGETHER = 4  # steps whose losses are copied to the host together
Label = tuple[int, str]  # step and loss term


class LossWatch:
    """Detector of losses that are not finite. On a CUDA device losses of several steps are copied to the host
    asynchronously and checked a few steps later."""

    def __init__(self) -> None:
        self._pending: list[tuple[list[Label], list[Tensor]]] = []
        self._in_flight: deque[tuple[list[Label], Tensor, torch.cuda.Event]] = deque()

    def note(self, scene: Scene, step: int, terms: dict[str, Tensor]) -> None:
        """Check the loss terms of a step. Raises TrainingDiverged: one of this or an earlier step is not finite."""
        labels = [(step, name) for name in terms]
        values = [term.detach() for term in terms.values()]
        if values[0].device.type != "cuda":
            self._check(scene, labels, torch.stack(values))
            return
        self._pending.append((labels, values))
        if len(self._pending) >= TOGETHER:
            self._send()
        while self._in_flight and self._in_flight[0][2].query():
            self._check(scene, *self._in_flight.popleft()[:2])

    def _send(self) -> None:
        if not self._pending:
            return
        values = torch.stack([value for _, values in self._pending for value in values])
        arrived = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
        arrived.copy_(values, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(values.device))
        self._in_flight.append(([label for labels, _ in self._pending for label in labels], arrived, event))
        self._pending = []

    def finish(self, scene: Scene) -> None:
        """Wait for pending losses and check them, as `note` does."""
        self._send()
        while self._in_flight:
            self._in_flight[0][2].synchronize()
            self._check(scene, *self._in_flight.popleft()[:2])

    def forget(self) -> None:
        """Discard pending losses."""
        self._in_flight.clear()
        self._pending.clear()

    @staticmethod
    def _check(scene: Scene, labels: list[Label], values: Tensor) -> None:
        for (step, name), value in zip(labels, values.tolist(), strict=True):
            if not math.isfinite(value):
                cause = describe_broken(scene) or "all parameters are finite; look for NaN in the images and cameras"
                raise TrainingDiverged(f"the {name} loss is {value} at step {step}: {cause}")


class TrainingDiverged(ValueError):
    """Training has diverged and cannot go on."""


def describe_broken(module: nn.Module) -> str:
    """Name the first parameter that is not finite, and its row; empty if all are finite."""
    for name, parameter in module.named_parameters():
        if len(parameter) == 0:
            continue
        broken = ~torch.isfinite(parameter.detach().reshape(len(parameter), -1)).all(-1)
        if bool(broken.any()):
            rows = broken.nonzero().flatten()
            return f"{name} is not finite in {len(rows)} of {len(parameter)} rows, the first is row {int(rows[0])}"
    return ""
