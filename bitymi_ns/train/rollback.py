"""Rollback of diverged training: detects divergence, restores the last good state, and lowers the learning rates.

Divergence is one of:
- a loss that is not finite because of a parameter (not because of broken images, which a rollback cannot repair);
- more than a hundredth of the surfels not finite (fewer are dropped and counted);
- views rendered worse than blank ones: the mean photometric loss over a window of steps exceeds both the loss of images
  of constant mean colour and that of the scene at the start of the run; by a quarter in the first tenth and in the
  first 100 steps of the run;
- views rendered worse than before: the mean over a window exceeds that of the best window since the start or the last
  rollback, by a quarter and by a tenth of the blank loss. Windows are whole epochs, so that all are means over the same
  views. When the resolution changes, earlier losses are converted by the loss of a few views at both resolutions.

Losses in the first half of the interval after an opacity reset are ignored: opacities recover in that time
(`Schedule.reset_opacity`). The last window ends with the run. When the texel stage begins, windows start over, so that
the rise of the loss caused by the schedule does not count as divergence.

A rollback restores parameters, optimisers, exposures, poses and the strategy's statistics from the start of the last
good window; the step count continues. All learning rates are then multiplied by `guard.rates`, or by a higher power of
it for each further rollback without a good window between. After the first good window they return to normal; if the
run then diverges again, they stay lowered.
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

WORSE = 1.25
"""Ratio to the best window's mean loss, or early in the run to the blank loss, above which a window is bad."""
RISE = 0.1
"""Share of the blank loss by which a bad window must also exceed the best one: losses near 0 may double."""
EARLY = 0.1  # share of the run in which views may be slightly worse than blank ones
EARLY_STEPS = 100  # minimum number of such steps, in runs of any length: surfels need time to settle
BROKEN_SHARE = 0.01  # surfels that are not finite are dropped up to this share of all; beyond, the run rolls back
COMPARED_VIEWS = 4  # views for the loss of blank images, of the initial scene and at a change of resolution
SHARE_OF_RUN = 5  # a window is at most 1 / SHARE_OF_RUN of the run, even if that is less than an epoch


class RollbackGuard:
    """Rollback guard of a run.

    Attributes:
        factor: of all learning rates; 1 before the first rollback.
        rollbacks: number of rollbacks.
    """

    def __init__(
        self,
        scene: Scene,
        optimizers: Mapping[str, Optimizer],
        strategy: Strategy,
        exposure: Exposure,
        poses: Poses,
        announce: Callable[[str], None],
    ) -> None:
        self.scene, self.optimizers, self.strategy = scene, optimizers, strategy
        self.exposure, self.poses = exposure, poses
        self.schedule, self.config, self.processes = strategy.schedule, strategy.config, strategy.processes
        self.announce = announce
        self.window = max(self.config.guard.min_window, self.schedule.scaled(self.config.guard.window))
        self.factor, self.rollbacks = 1.0, 0
        self._rates_restored = False  # rates have returned to normal once
        self._streak = 0  # rollbacks in a row without a good window
        self._limit, self._best = math.nan, math.inf  # mean losses: blank or initial, and of the best window
        self._views: DownscaledViews | None = None
        # on the scene's device, to avoid synchronisation: sum of losses, largest count of surfels that are not finite
        self._sum, self._broken, self._count = torch.zeros(()), torch.zeros(1, dtype=torch.int32), 0
        self._states: list[tuple[int, dict[str, Any]]] = []  # (step, state); the older one is known to be good

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run, without captured states: it cannot roll back to before it resumed."""
        return {
            "factor": self.factor,
            "rollbacks": self.rollbacks,
            "returned": self._rates_restored,
            "streak": self._streak,
            "limit": self._limit,
            "best": self._best,
            "sum": float(self._sum),
            "count": self._count,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.factor, self.rollbacks = float(state["factor"]), int(state["rollbacks"])
        self._rates_restored, self._streak = bool(state.get("returned", False)), int(state["streak"])
        self._limit, self._best = float(state["limit"]), float(state.get("best", math.inf))
        self._sum, self._count = torch.tensor(state["sum"]), int(state["count"])
        self._states = []

    @property
    def on(self) -> bool:
        """True if rollbacks are enabled."""
        return self.config.guard.rollbacks > 0

    def before(self, step: int, views: DownscaledViews) -> None:
        """Capture a state if there is none, and measure the initial loss once; call it before each step. `views`:
        training views. Losses are compared at full size: images too small for SSIM have smaller losses."""
        if not self.on or self._states:
            return
        self._views = views
        epoch = len(views) // math.gcd(len(views), self.processes.views)  # steps that use all views equally often
        epochs = -(-self.window // epoch) * epoch
        self.window = max(self.window, min(epochs, self.schedule.max_steps // SHARE_OF_RUN))
        if math.isnan(self._limit):
            self._limit = max(self._loss_of(views, 1.0), self._loss_of(views, 1.0, blank=True))
        self._states = [(step, self._capture())]

    def restart(self, forget: bool = False) -> None:
        """Discard captured states and start a new window, when the scene's texture becomes texels; with `forget` also
        the loss of the best window."""
        self._states = []
        self._best = math.inf if forget else self._best
        self._sum, self._count = torch.zeros_like(self._sum), 0

    @torch.no_grad()
    def _loss_of(self, views: DownscaledViews, factor: float, blank: bool = False) -> float:
        """Compute the mean loss of a few views, resized by `factor`, of the scene or of images of their mean colour."""
        losses = []
        device = self.scene.surfels["means"].device
        for i in spread(len(views), COMPARED_VIEWS):
            view = views.at(i, factor)
            # as in training steps, but always the same colours if they are random
            background = step_background(self.config, view, i, device)
            target = view.target(background, device)
            if blank:
                drawn = target.mean((0, 1)).expand_as(target).contiguous()
            else:
                output = self.scene.render(view.camera.to(device), background=background, field_mode="frozen")
                drawn = view.shown(output.rgb, output.alpha, background)
                del output  # frees its fragments before the next view is rendered
            losses.append(photometric(drawn, target, self.config.loss.ssim_weight, view.mask))
        return self.processes.mean(float(torch.stack(losses).mean()))

    def _convert(self, step: int) -> None:
        """Convert the losses measured so far to the resolution of the next step."""
        before, now = (self.schedule.resolution_factor(s) for s in (step, step + 1))
        if before == now or self._views is None:
            return
        if self.schedule.recovering(step + 1):  # opacities are low: losses are not comparable
            self._best = math.inf
            return
        old, new = self._loss_of(self._views, before), self._loss_of(self._views, now)
        if math.isfinite(old) and math.isfinite(new) and old > 0.0:
            self._best, self._sum = self._best * new / old, self._sum * (new / old)

    def failed(self, step: int, error: TrainingDiverged) -> dict[str, float]:
        """Repair the scene after a loss that is not finite (the step is then repeated), or after an update broke it.
        Returns counts of what was done, by name. Raises TrainingDiverged: no parameter is broken, rollbacks are
        disabled or used up, or no state was captured."""
        cause = describe_broken(self.scene)
        if not self.on or not cause:
            raise error
        return self._repair(step, cause)

    def after(self, step: int, loss: Tensor, broken: Tensor) -> dict[str, float]:
        """Check for divergence and roll back if needed; call it after each step's optimisers and strategy.

        Args:
            loss: scalar, photometric loss of the step, detached. Read at the end of a window only.
            broken: [1] int32, number of surfels that are not finite; on a CUDA device read at the end of a window, on
                the CPU in each step.

        Returns:
            Counts of what was done, by name; empty if nothing was, or rollbacks are disabled.

        Raises:
            TrainingDiverged: the limit of rollbacks is reached, or no state was captured.
        """
        if not self.on:
            return {}
        if self.schedule.recovering(step):
            self._sum, self._count = torch.zeros_like(loss), 0
        else:
            self._sum, self._count = self._sum.to(loss) + loss, self._count + 1
        self._broken = torch.maximum(self._broken.to(broken), broken)
        last = step + 1 >= self.schedule.max_steps
        ends = (self.schedule.max_steps - 1 - step) % self.window == 0
        if ends or broken.device.type == "cpu":
            most = int(self._broken)
            self._broken = torch.zeros_like(broken)
            if most > BROKEN_SHARE * len(self.scene):
                return self._go_back(step, describe_broken(self.scene) or f"{most} surfels are not finite")
        if not ends:
            self._convert(step)
            return {}
        mean = float(self._sum) / self._count if self._count else 0.0
        enough, whole = self._count >= self.config.guard.min_window, self._count >= self.window
        self._sum, self._count = torch.zeros_like(loss), 0
        early = max(EARLY * self.schedule.max_steps, EARLY_STEPS)
        if enough and mean > self._limit * (WORSE if step < early else 1.0):
            return self._go_back(step, f"the views are drawn worse than blank ones (loss {mean:.3f})")
        if whole and mean - self._best > max((WORSE - 1.0) * self._best, RISE * self._limit):
            return self._go_back(
                step, f"the views are drawn worse than before (loss {mean:.3f} after {self._best:.3f})"
            )
        cause = describe_broken(self.scene)
        if cause:
            return self._repair(step, cause)
        self._streak = 0
        if whole:
            self._best = min(self._best, mean)
            if self.factor < 1.0 and not self._rates_restored:
                self.factor, self._rates_restored = 1.0, True
                self.announce(f"step {step}: learning rates return to normal")
        self._convert(step)
        if not last and not (enough and mean > self._limit):  # a state that also passes the later, stricter test
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
        options = self.config.guard
        if self.rollbacks >= options.rollbacks or not self._states:
            tried = f" It went back {self.rollbacks} times, to learning rates times {self.factor:.2g}." * bool(
                self.rollbacks
            )
            raise TrainingDiverged(f"training diverged at step {step}: {cause}.{tried} Lower the learning rates")
        origin, state = self._states[0]
        self.rollbacks += 1
        self._streak += 1
        self.factor *= options.rates**self._streak
        self._restore(state)
        self._states = [(origin, state)]
        self._sum, self._count, self._best = torch.zeros_like(self._sum), 0, math.inf
        self.announce(
            f"step {step}: training diverged ({cause}); back to the state before step {origin}, "
            f"with learning rates times {self.factor:.2g} from here on"
        )
        return {"rolled_back": float(step - origin), "rates": self.factor, "surfels": float(len(self.scene))}

    def _capture(self) -> dict[str, Any]:
        scene = {name: value.detach() for name, value in self.scene.state_dict().items()}
        # texels dominate the memory of a state: buffers that never change in place are shared between states, and
        # texels are kept in half precision, whose error of 2^-11 of a residual is invisible
        textured = isinstance(self.scene.field, TexelField)
        steady = {f"field.{name}" for name in TexelField.STEADY} if textured else set()
        texels = {"field.texels"} if textured else set()
        return {
            "scene": {
                name: value if name in steady else value.half() if name in texels else value.clone()
                for name, value in scene.items()
            },
            "optimizers": {name: copy.deepcopy(o.state_dict()) for name, o in self.optimizers.items()},
            "strategy": self.strategy.state_dict(),
            "exposure": self.exposure.state_dict(),
            "poses": self.poses.state_dict(),
        }

    def _restore(self, state: Mapping[str, Any]) -> None:
        # new Parameters, as a live autograd graph relies on the shapes of the old ones
        surfels = self.scene.surfels
        rows = {name: state["scene"][f"surfels.{name}"] for name in surfels.keys()}
        none = torch.zeros(0, dtype=torch.int64, device=surfels["means"].device)
        replace_rows(surfels, self.optimizers, none, rows, self.strategy.on_resize)
        if isinstance(self.scene.field, TexelField):
            self.scene.resize_for_state(state["scene"])
        self.scene.load_state_dict(state["scene"])
        self.scene.zero_grad(set_to_none=True)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(copy.deepcopy(state["optimizers"][name]))
        self.strategy.load_state_dict(state["strategy"])
        self.poses.load_state_dict(state["poses"])
        if self._views is not None:
            self.exposure.load_state_dict(state["exposure"], len(self._views), surfels["means"].device)
