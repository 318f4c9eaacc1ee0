"""Rollback of diverged training: detects divergence, restores the last good state, and lowers the learning rates.

Divergence is one of:
- a loss that is not finite because of a parameter (not because of broken images, which a rollback cannot repair);
- a field that is not finite, or more than a hundredth of the surfels (fewer are dropped and counted);
- a mean photometric loss over a window of steps that exceeds that of images of constant mean colour, and that of the
  initial scene; early in the run by a quarter. Losses from an opacity reset until opacities have recovered are ignored.

A rollback restores parameters, optimisers, exposures, poses and the strategy's statistics from the start of the last
good window; the step count continues. Each rollback multiplies all learning rates by `guard.rates`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from bitymi_ns.ranges import spread
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.divergence import TrainingDiverged, describe_broken
from bitymi_ns.train.losses import photometric
from bitymi_ns.train.optimizers import replace_rows
from bitymi_ns.train.strategy import Strategy, finite_rows
from bitymi_ns.train.views import DownscaledViews, step_background

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene
    from bitymi_ns.train.exposure import Exposure
    from bitymi_ns.train.poses import Poses

WORSE = 1.25  # ratio to the loss of blank images or of the initial scene above which an early window is bad; later 1
EARLY, EARLY_STEPS = 0.1, 100  # share of the run, and minimum number of steps, in which surfels settle
BROKEN_SHARE = 0.01  # surfels that are not finite are dropped up to this share of all; beyond, the run rolls back
COMPARED_VIEWS = 4  # views for the loss of blank images and of the initial scene


class RollbackGuard:
    """Rollback guard of a run; `factor` is that of all learning rates, 1 before the first of its `rollbacks`."""

    def __init__(
        self,
        scene: Scene,
        optimizers: Mapping[str, Optimizer],
        strategy: Strategy,
        exposure: Exposure,
        poses: Poses,
        announce: Callable[[str], None],
    ) -> None:
        self.scene, self.optimizers, self.strategy, self.announce = scene, optimizers, strategy, announce
        self.exposure, self.poses = exposure, poses
        self.schedule, self.options = strategy.schedule, strategy.config.guard
        self.on = self.options.rollbacks > 0
        self.window = max(self.options.min_window, self.schedule.scaled(self.options.window))
        self.factor, self.rollbacks = 1.0, 0
        self._limit = math.nan  # loss of blank images, or of the initial scene
        self._views = 0  # number of training views
        self._sum, self._count = 0.0, 0  # of losses; stays on their device to avoid synchronisation
        self._states: list[tuple[int, dict[str, Any]]] = []  # (step, state); the older one is known to be good

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run, without captured states: it cannot roll back to before it resumed."""
        kept = {"factor": self.factor, "rollbacks": self.rollbacks, "limit": self._limit}
        return kept | {"sum": float(self._sum), "count": self._count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.factor, self.rollbacks = float(state["factor"]), int(state["rollbacks"])
        self._limit, self._sum, self._count = float(state["limit"]), float(state["sum"]), int(state["count"])
        self._states = []

    def before(self, step: int, views: DownscaledViews) -> None:
        """Capture a state if there is none, and measure the loss of the initial scene and of blank images once; call it
        before each step. `views`: training views."""
        if not self.on or self._states:
            return
        self._views = len(views)
        if math.isnan(self._limit):
            self._limit = self._loss_of(views)
        self._states = [(step, self._capture())]

    def restart(self) -> None:
        """Discard captured states and start a new window, when the scene's texture becomes texels."""
        self._states, self._sum, self._count = [], 0.0, 0

    @torch.no_grad()
    def _loss_of(self, views: DownscaledViews) -> float:
        """Compute the mean loss of a few views at full size, of the scene or of images of their mean colour: the larger
        one. Images too small for SSIM have smaller losses."""
        losses, device = [], self.scene.surfels["means"].device
        for i in spread(len(views), COMPARED_VIEWS):
            view = views.at(i, 1.0)
            # as in training steps, but always the same colours if they are random
            background = step_background(self.strategy.config, view, i, device)
            target = view.target(background, device)
            output = self.scene.render(view.camera.to(device), background=background, field_mode="frozen")
            images = (view.shown(output.rgb, output.alpha, background), target.mean((0, 1)).expand_as(target))
            del output  # frees its fragments before the next view is rendered
            weight = self.strategy.config.loss.ssim_weight
            losses.append(torch.stack([photometric(x.contiguous(), target, weight, view.mask) for x in images]))
        return max(self.strategy.processes.mean(float(loss)) for loss in torch.stack(losses).mean(0))

    def failed(self, step: int, error: TrainingDiverged) -> dict[str, float]:
        """Repair the scene after a loss that is not finite (the step is then repeated), or after an update broke it.
        Returns counts by action. Raises TrainingDiverged: no parameter is broken, or the run cannot go back."""
        cause = describe_broken(self.scene)
        if not self.on or not cause:
            raise error
        return self._repair(step, cause)

    def after(self, step: int, loss: Tensor) -> dict[str, float]:
        """Check for divergence at the end of a window and roll back if needed; call it after each step's optimisers and
        strategy. `loss`: scalar, photometric loss of the step, detached. Returns counts by action. Raises
        TrainingDiverged: the run cannot go back."""
        if not self.on:
            return {}
        if self.schedule.recovering(step):
            self._sum, self._count = 0.0, 0
        else:
            self._sum, self._count = self._sum + loss, self._count + 1
        left = self.schedule.max_steps - 1 - step
        if left % self.window:  # the last window ends with the run
            return {}
        mean, enough = float(self._sum) / max(1, self._count), self._count >= self.options.min_window
        self._sum, self._count = 0.0, 0
        early = step < max(EARLY * self.schedule.max_steps, EARLY_STEPS)
        if enough and mean > self._limit * (WORSE if early else 1.0):
            return self._go_back(step, f"the views are drawn worse than blank ones (loss {mean:.3f})")
        if cause := describe_broken(self.scene):
            return self._repair(step, cause)
        if left and not (enough and mean > self._limit):  # a state that also passes the later, stricter test
            self._states = self._states[-1:]  # frees the large old state before the next is captured
            self._states.append((step + 1, self._capture()))
        return {}

    def _repair(self, step: int, cause: str) -> dict[str, float]:
        """Drop surfels that are not finite; roll back if there are many, or if the field is broken."""
        broken = ~finite_rows(self.scene)
        dropped = float(broken.sum())
        field_broken = self.scene.field is not None and describe_broken(self.scene.field)
        if field_broken or dropped > BROKEN_SHARE * len(self.scene):
            return self._go_back(step, cause)
        self.strategy.remove(broken, self.scene, self.optimizers)
        self.announce(f"step {step}: {dropped:.0f} surfels were no longer finite and were dropped")
        return {"not_finite": dropped, "surfels": float(len(self.scene))}

    def _go_back(self, step: int, cause: str) -> dict[str, float]:
        if self.rollbacks >= self.options.rollbacks or not self._states:
            tried = f" It went back {self.rollbacks} times, to learning rates times {self.factor:.2g}."
            tried = tried if self.rollbacks else ""
            raise TrainingDiverged(f"training diverged at step {step}: {cause}.{tried} Lower the learning rates")
        del self._states[1:]
        origin, state = self._states[0]
        self.rollbacks += 1
        self.factor *= self.options.rates
        self._restore(state)
        self._sum, self._count = 0.0, 0
        self.announce(
            f"step {step}: training diverged ({cause}); back to the state before step {origin}, "
            f"with learning rates times {self.factor:.2g} from here on"
        )
        return {"rolled_back": float(step - origin), "rates": self.factor, "surfels": float(len(self.scene))}

    def _capture(self) -> dict[str, Any]:
        # texels dominate a state: their steady buffers are shared between states, and they are kept in half precision,
        # whose error of 2^-11 of a residual is invisible
        texels = isinstance(self.scene.field, TexelField)
        shared = {f"field.{name}" for name in TexelField.STEADY} if texels else {}
        scene = {
            name: value if name in shared else value.half() if name == "field.texels" else value.clone()
            for name, value in self.scene.state_dict().items()
        }
        parts = {"strategy": self.strategy, "exposure": self.exposure, "poses": self.poses} | dict(self.optimizers)
        return {"scene": scene} | {name: copy.deepcopy(part.state_dict()) for name, part in parts.items()}

    def _restore(self, state: Mapping[str, Any]) -> None:
        # new Parameters, as a live autograd graph relies on the shapes of the old ones
        surfels = self.scene.surfels
        rows = {name: state["scene"][f"surfels.{name}"] for name in surfels.keys()}
        none = surfels["means"].new_zeros(0, dtype=torch.int64)
        replace_rows(surfels, self.optimizers, none, rows, self.strategy.on_resize)
        if isinstance(self.scene.field, TexelField):
            self.scene.resize_for_state(state["scene"])
        self.scene.load_state_dict(state["scene"])
        self.scene.zero_grad(set_to_none=True)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(copy.deepcopy(state[name]))
        self.strategy.load_state_dict(state["strategy"])
        self.poses.load_state_dict(state["poses"])
        self.exposure.load_state_dict(state["exposure"], self._views, surfels["means"].device)
