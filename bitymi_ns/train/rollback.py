"""Rollback of diverged training to the last good state, with lower learning rates.

Divergence is a field or too many surfels that are not finite, or a window of steps, without those that recover from an
opacity reset, whose mean photometric loss exceeds that of images of their mean colour and of the initial scene.
The step count goes on.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.ranges import spread
from bitymi_ns.scene.field import TexelField
from .divergence import TrainingDiverged, describe_broken
from .exposure import Exposure
from .losses import photometric
from .optimizers import replace_rows
from .poses import Poses
from .strategy import Strategy, finite_rows
from .views import DownscaledViews, step_background

WORSE = 1.25  # ratio to the limit of the loss above which an early window is bad; later 1
EARLY, EARLY_STEPS = 0.1, 100  # fraction of the run, and minimum number of steps, in which surfels settle
MOST_BROKEN = 0.01  # fraction of surfels that are dropped if they are not finite; beyond, the run rolls back
COMPARED_VIEWS = 4  # views for the limit of the loss


class RollbackGuard:
    """Rollback guard of a run; `factor` of all learning rates is 1 before the first of its `rollbacks`."""

    def __init__(self, strategy: Strategy, exposure: Exposure, poses: Poses, announce: Callable[[str], None]) -> None:
        self.scene, self.strategy, self.announce = strategy.scene, strategy, announce
        self._parts = {"strategy": strategy, "exposure": exposure, "poses": poses, **strategy.optimizers}
        self.schedule, self.options = strategy.schedule, strategy.config.guard
        self.window = max(self.options.min_window, self.schedule.scaled(self.options.window))
        self.factor, self.rollbacks = 1.0, 0
        self._limit = math.nan  # loss of blank images, or of the initial scene
        self.restart()

    def restart(self) -> None:
        """Discard captured states and start a new window."""
        self._states: list[tuple[int, dict[str, Any]]] = []  # (step, state); the older one is known to be good
        self._sum, self._count = 0.0, 0  # of losses, on their device to avoid synchronisation

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run, without captured states."""
        losses = {"limit": self._limit, "sum": float(self._sum), "count": self._count}
        return {"factor": self.factor, "rollbacks": self.rollbacks, **losses}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.restart()
        self.factor, self.rollbacks = float(state["factor"]), int(state["rollbacks"])
        self._limit, self._sum, self._count = float(state["limit"]), float(state["sum"]), int(state["count"])

    def before(self, step: int, views: DownscaledViews) -> None:
        """Before each step, capture a state if there is none; measure the limit of the loss once."""
        if not self.options.rollbacks or self._states:
            return
        if math.isnan(self._limit):
            self._limit = self._loss_of(views)
        self._states = [(step, self._capture())]

    @torch.no_grad()
    def _loss_of(self, views: DownscaledViews) -> float:
        """Compute the mean loss of a few views at full size, of the scene or of images of their mean colour: the larger
        one."""
        config, device, losses = self.strategy.config, self.scene.surfels["means"].device, []
        for i in spread(len(views), COMPARED_VIEWS):
            view = views.at(i, 1.0)
            _, rgb, target = view.drawn(self.scene, step_background(config, view, i, device))
            blank = target.mean((0, 1)).expand_as(target).contiguous()
            weight = config.loss.ssim_weight
            losses.append(torch.stack([photometric(x, target, weight, view.mask) for x in (rgb.contiguous(), blank)]))
        return max(self.strategy.processes.mean(float(loss)) for loss in torch.stack(losses).mean(0))

    def after(self, step: int, loss: Tensor) -> dict[str, float]:
        """After each step's optimisers and strategy, check for divergence if a window ends. `loss`: photometric, of the
        step, detached. Returns and raises as `repair`."""
        if not self.options.rollbacks:
            return {}
        recovering = self.schedule.recovering(step)
        self._sum, self._count = (0.0, 0) if recovering else (self._sum + loss, self._count + 1)
        steps_left = self.schedule.max_steps - 1 - step
        if steps_left % self.window:  # the last window ends with the run
            return {}
        mean = float(self._sum) / self._count if self._count >= self.options.min_window else 0.0  # 0: too few to judge
        self._sum, self._count = 0.0, 0
        early = step < max(EARLY * self.schedule.max_steps, EARLY_STEPS)
        if mean > self._limit * (WORSE if early else 1.0):
            return self._go_back(step, f"the views are drawn worse than blank ones (loss {mean:.3f})")
        if describe_broken(self.scene):
            return self.repair(step)
        if steps_left and not mean > self._limit:  # passes the later test, too
            self._states = self._states[-1:]  # frees the large old state before the next is captured
            self._states.append((step + 1, self._capture()))
        return {}

    def repair(self, step: int, error: TrainingDiverged | None = None) -> dict[str, float]:
        """Drop surfels that are not finite; roll back if they are many, or the field is broken. Returns counts by
        action. Raises TrainingDiverged: the run cannot go back, or no parameter explains `error`."""
        cause = describe_broken(self.scene)
        if error is not None and not (self.options.rollbacks and cause):
            raise error
        broken = ~finite_rows(self.scene)
        dropped = float(broken.sum())
        field = self.scene.field
        if dropped > MOST_BROKEN * len(self.scene) or (field is not None and describe_broken(field)):
            return self._go_back(step, cause)
        self.strategy.remove(broken)
        self.announce(f"step {step}: {dropped:.0f} surfels were no longer finite and were dropped")
        return {"not_finite": dropped, "surfels": float(len(self.scene))}

    def _go_back(self, step: int, cause: str) -> dict[str, float]:
        if self.rollbacks >= self.options.rollbacks or not self._states:
            tried = f" after {self.rollbacks} rollbacks (rates times {self.factor:.2g})" if self.rollbacks else ""
            raise TrainingDiverged(f"training diverged at step {step}{tried}: {cause}. Lower the learning rates")
        origin, state = self._states[0]
        self.rollbacks, self.factor = self.rollbacks + 1, self.factor * self.options.rates
        self.restart()
        self._states = [(origin, state)]
        # new Parameters: a live autograd graph relies on the shapes of the old ones
        surfels = self.scene.surfels
        scene, none = state["scene"], surfels["means"].new_zeros(0, dtype=torch.int64)
        rows = {name: scene[f"surfels.{name}"] for name in surfels.keys()}
        replace_rows(surfels, self.strategy.optimizers, none, rows, self.strategy.on_resize)
        self.scene.resize_for_state(scene)
        self.scene.load_state_dict(scene)
        self.scene.zero_grad(set_to_none=True)
        for name, part in self._parts.items():
            part.load_state_dict(copy.deepcopy(state[name]))
        self.announce(
            f"step {step}: training diverged ({cause}); back to the state before step {origin}, with learning rates "
            f"times {self.factor:.2g}"
        )
        return {"rolled_back": float(step - origin), "rates": self.factor, "surfels": float(len(self.scene))}

    def _capture(self) -> dict[str, Any]:
        # texels dominate a state: steady buffers are shared between states, residuals kept in half precision
        steady = {f"field.{name}" for name in TexelField.STEADY}
        scene = {
            name: value if name in steady else value.half() if name == "field.texels" else value.clone()
            for name, value in self.scene.state_dict().items()
        }
        return {"scene": scene} | {name: copy.deepcopy(part.state_dict()) for name, part in self._parts.items()}
