"""The training step of `fit` and of nerfstudio's training loop."""

from __future__ import annotations

import functools
import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor
from torch.optim import Optimizer

from bitymi_ns.ops.backend import give_back_memory
from bitymi_ns.ops.parameters import SHAPE_LIMIT
from bitymi_ns.ops.training_view import ComparedView, PhotographTarget
from bitymi_ns.ranges import spread
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.scene import RenderOutput
from .config import TrainConfig
from .divergence import LossWatch, TrainingDiverged
from .exposure import Exposure
from .losses import fused_losses, objective
from .messages import memory_reached
from .optimizers import ResizeHook, set_rate
from .poses import Poses
from .processes import ALONE, Processes
from .rollback import RollbackGuard
from .schedules import Schedule
from .step_sizes import StepSizes
from .strategy import Strategy
from .texels import LearningTexels
from .views import (
    DownscaledViews,
    TrainingData,
    View,
    at_size,
    background_changes,
    random_numbers,
    step_background,
)

if TYPE_CHECKING:
    from bitymi_ns.ops import TexelDescent
    from bitymi_ns.ops.project import Projection
    from bitymi_ns.scene.scene import Scene

DROPOUT_NUMBERS = 1 << 30  # random number of the first step's dropout; below are those of backgrounds and view order
TIMED_VIEWS = 3  # views that tell what a step takes at another size


def with_dropout(opacity_logits: Tensor, probability: float, seed: int, step: int) -> Tensor:
    """Leave out surfels of a view at random, as dropout does with the units of a network (Srivastava et al. 2014): [N]
    logits to draw the view with.

    The odds of the others' opacities are divided by 1 - `probability`, which for small opacities preserves the expected
    one. Those left out have no gradient. The choice depends on `seed`, `step` and the kind of device."""
    numbers = random_numbers(seed, DROPOUT_NUMBERS + step, opacity_logits.device)
    left_out = torch.rand(opacity_logits.shape, generator=numbers, device=opacity_logits.device) < probability
    return torch.where(left_out, -SHAPE_LIMIT, opacity_logits - math.log1p(-probability))


def view_losses(
    scene: Scene,
    view: View,
    schedule: Schedule,
    step: int,
    watch: LossWatch,
    background: Tensor | None = None,
    descent: TexelDescent | None = None,
    dropout: float = 0.0,
) -> tuple[dict[str, Tensor], RenderOutput | ComparedView]:
    """Render a training view and compare it with its photograph, by the schedule.

    Args:
        view: on the scene's device, with its image at its camera's size.
        background: [3] colour behind the scene, where it is constant over steps; None: by the options.
        descent: see `Scene.render`.
        dropout: probability with which a surfel is left out.

    Returns:
        The weighted loss terms (`objective`) and the rendered view: a `ComparedView` without image if one CUDA function
        does both.

    Raises:
        TrainingDiverged: the loss is not finite.
    """
    config, loss = schedule.config, schedule.config.loss
    device = scene.surfels["means"].device
    if background is None or background_changes(config, view):
        background = step_background(config, view, step, device)
    target = view.target(background, device)
    logits = with_dropout(scene.surfels["opacity_logits"], dropout, config.seed, step) if dropout else None
    field_mode: Literal["train", "frozen"] = "train" if schedule.field_trains(step) else "frozen"
    maps = (view.depth is not None or view.normal is not None) and schedule.geometry_counts(step)
    overdraw_half = loss.overdraw_half if schedule.overdraw_counts(step) else None
    compared: ComparedView | None = None
    if not maps and overdraw_half is None and fused_losses(loss, target):
        weights = (loss.ssim_weight, loss.falloff_weight, loss.falloff_gamma)
        photograph = PhotographTarget(target, view.mask, background, *weights)
        compared = scene.compare(view.camera, photograph, view.correction, field_mode, descent, logits)
    output = shown = compared or scene.render(view.camera, background, field_mode, maps, overdraw_half, descent, logits)
    if isinstance(output, RenderOutput):  # the other one is corrected already
        shown = replace(output, rgb=view.shown(output.rgb, output.alpha, background))
    terms = objective(shown, target, loss, view.mask, view.depth, view.normal)
    watch.note(scene, step, terms)
    return terms, output


class Training:
    """A training run. Each step calls, in this order:

    `begin` -> zero the gradients -> `losses` -> backward of their sum -> `combine` -> optimisers -> `finish`.

    A step minimises the mean loss over the views of all processes. Each makes the same calls at the same steps,
    `losses` and backward once for each of its own views.

    Attributes:
        step: index of the current step.
        exposure, poses: corrections of the training photographs.
        clock: time spent between `begin` and `finish`.
        background: as in `view_losses`.
    """

    def __init__(
        self,
        scene: Scene,
        data: TrainingData,
        optimizers: Mapping[str, Optimizer],
        config: TrainConfig,
        max_steps: int,
        on_resize: ResizeHook | None = None,
        announce: Callable[[str], None] = warnings.warn,
        processes: Processes = ALONE,
    ) -> None:
        """
        Args:
            scene: changed in place.
            optimizers: as of `make_optimizers`.
            max_steps: length of the run.
            announce: called with a sentence on rollbacks, dropped surfels and limits of memory.

        Raises:
            ValueError: a training option is out of its range.
        """
        self.scene = scene
        self.optimizers = optimizers
        self.processes = processes
        textured = scene.config.texture == "texels"
        pixels = data.covered * data.image_pixels / max(1, len(data.views))
        self.schedule = Schedule(config, max_steps, data.extent, textured, pixels)
        grown = (on_resize, data.image_pixels, data.first_surfels, processes)
        self.strategy = Strategy(scene, optimizers, self.schedule, *grown)
        self.exposure = Exposure(config.exposure, data.exif_stops, data.files)
        self.poses = Poses(self.schedule, data.cameras)
        self.announce = announce
        self.guard = RollbackGuard(self.strategy, self.exposure, self.poses, announce)
        self.texels = LearningTexels(scene, self.schedule, processes)
        self.watch = LossWatch()
        self.step_sizes = StepSizes(self.schedule, data.cameras)
        self.clock = Stopwatch()
        self.background: Tensor | None = None
        self.step = 0
        self._full_size = data.views
        self._projections: list[Projection] = []
        self._photometric: list[Tensor] = []
        self._synchronised = processes.count == 1

    @functools.cached_property
    def views(self) -> DownscaledViews:
        """Training views, created at first use, as their cache takes a share of the free GPU memory."""
        return DownscaledViews(self._full_size, self.scene.surfels["means"].device, self.exposure.of, self.poses.of)

    def view(self, index: int) -> View:
        """Return training view `index` at the resolution and pose of the current step."""
        view = self.views.at(index, self.schedule.resolution_factor(self.step))
        correction = self.exposure.learning(index, view.correction)
        return view._replace(camera=self.poses.learning(index, view.camera, self.step), correction=correction)

    def begin(self, step: int) -> None:
        """Start a step and its clock, the exposure corrections or the texel stage if due, and set the rates."""
        if not self._synchronised:  # before the clock starts: waiting for other processes is no training time
            self.processes.broadcast_(self.scene.state_dict().values())
        self.clock.start()
        self.step = step
        self.poses.begin()
        self.exposure.begin()
        if not self.exposure.decided:
            self.exposure.start(self.scene.surfels["means"], self._full_size, self.scene.near)
        if not self._synchronised:
            self._synchronised = True
            device = self.scene.surfels["means"].device
            self.exposure.load_state_dict(self.processes.from_first(self.exposure.state_dict(), device), device=device)
        began = self.texels.begin(step, self.views)
        if began:
            self.guard.restart()
            if self.texels.most_by_memory:
                self.announce(memory_reached("Texels", self.texels.most_by_memory))
        if began or self.schedule.resolution_factor(step) != self.schedule.resolution_factor(max(0, step - 1)):
            give_back_memory()
        self.guard.before(step, self.views)
        self.step_sizes.measure(self.scene, always=began)
        self._set_rates()

    def _set_rates(self) -> None:
        for name, optimizer in self.optimizers.items():
            set_rate(optimizer, self.guard.factor * self.step_sizes.rate(name, self.step))

    def losses(self, view: View) -> tuple[dict[str, Tensor], RenderOutput | ComparedView]:
        """Compute `view_losses`; if one is not finite, the guard repairs the scene and the view is rendered again.
        Raises TrainingDiverged: see `RollbackGuard.repair`."""
        dropout = self.schedule.dropout(self.processes.views * self.schedule.max_steps / len(self._full_size))
        while True:
            descent = self.texels.prepare(self.step, view, self.guard.factor)
            diverged: TrainingDiverged | None = None
            how = (self.watch, self.background, descent, dropout)
            try:
                terms, output = view_losses(self.scene, view, self.schedule, self.step, *how)
            except TrainingDiverged as error:
                diverged = error
            problem = self.processes.first_error(None if diverged is None else str(diverged))
            if problem is None:
                self._projections.append(output.projection)
                self._photometric.append(terms["photometric"].detach())
                return terms, output
            self.watch.forget()
            self.guard.repair(self.step, diverged or TrainingDiverged(problem))
            self.step_sizes.measure(self.scene)
            self._set_rates()

    def seconds_at(self, factor: float) -> float:
        """Measure the CPU seconds of a training view at another size, drawn, compared and differentiated, without a
        trace in the run: the least of a few, as the first ones pay for memory that later steps find."""
        learned = [parameter for parameter in self.scene.parameters() if parameter.requires_grad]
        seconds = []
        for index in spread(len(self._full_size), TIMED_VIEWS):
            full = self._full_size[index]
            view = at_size(full, full.camera.scaled(factor) if factor < 1.0 else full.camera, learned[0].device)
            begin = time.process_time()
            terms, _ = view_losses(self.scene, view, self.schedule, self.step, LossWatch(), self.background)
            torch.autograd.grad(torch.stack(list(terms.values())).sum(), learned, allow_unused=True)
            seconds.append(time.process_time() - begin)
        return min(seconds)

    def combine(self) -> dict[str, Tensor]:
        """Average the gradients over all views of the step, and update the texels, after the backward passes. Returns
        row factors for `optimizers.step`. Raises as `Processes.average_gradients`."""
        if self.processes.views > 1:
            groups = (group for optimizer in self.optimizers.values() for group in optimizer.param_groups)
            learned = [parameter for group in groups for parameter in group["params"]]
            self.processes.average_gradients(learned, len(self.scene))
            self.texels.average()
        self.texels.step()
        return self.step_sizes.factors()

    def finish(self) -> dict[str, float]:
        """After the optimisers, densify, prune, check for divergence and stop the clock. Returns numbers by action
        (pruned, rolled_back, ...). Raises TrainingDiverged: see `RollbackGuard.repair`."""
        step = self.step
        projections = self._projections
        photometric = self._photometric
        assert projections, "a step is finished after its losses"
        self._projections, self._photometric = [], []
        self.exposure.step(self.guard.factor * self.schedule.lr("exposure", step), self.processes)
        self.poses.step(projections, self.guard.factor * self.schedule.pose_pixels(step), self.processes)
        if not self.schedule.densification_over(step):
            self.strategy.accumulate(*projections)
        loss = photometric[0] if self.processes.views == 1 else torch.stack(photometric).sum()
        if self.processes.views > 1:
            self.processes.sum(loss)
            loss = loss / self.processes.views
        factor = self.schedule.resolution_factor(step)
        try:
            report = self.strategy.step(step, lambda k, generator: self.views.draw(k, generator, factor))
        except TrainingDiverged as error:  # the optimisers broke the field or all surfels after the last loss
            report = self.guard.repair(step, error)
        else:
            report |= self.guard.after(step, loss)
        if "most_by_memory" in report:
            self.announce(memory_reached("Surfels", self.strategy.most))
        if report:
            self.step_sizes.measure(self.scene)
        if "rolled_back" in report:
            self.watch.forget()
        self.clock.stop()
        return report

    @property
    def by_memory(self) -> dict[str, int]:
        """Numbers at which memory has stopped surfels and texels, if it has."""
        bounds = {"surfels": self.strategy.most_by_memory, "texels": self.texels.most_by_memory}
        return {f"{what}_by_memory": most for what, most in bounds.items() if most}

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the run, without scene and optimisers."""
        return {
            "strategy": self.strategy.state_dict(),
            "guard": self.guard.state_dict(),
            "exposure": self.exposure.state_dict(),
            "step_sizes": self.step_sizes.state_dict(),
            "poses": self.poses.state_dict(),
            "seconds": self.clock.seconds,
            "cpu_seconds": self.clock.cpu_seconds,
            "max_steps": self.schedule.max_steps,
            "texels_by_memory": self.texels.most_by_memory,
            "texels_start": self.schedule.texels_start if isinstance(self.scene.field, TexelField) else None,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned, also of a run of another length, after the scene."""
        schedule = self.schedule
        length = state.get("max_steps") or schedule.max_steps  # checkpoints of earlier versions have fewer entries
        if isinstance(self.scene.field, TexelField):
            begun = state.get("texels_start")
            earlier = Schedule(schedule.config, length, texels=True).texels_start
            schedule.plan(earlier if begun is None else int(begun))
        self.strategy.load_state_dict(state["strategy"])
        self.texels.most_by_memory = int(state.get("texels_by_memory", 0))
        if "guard" in state:
            self.guard.load_state_dict(state["guard"])
            if length != schedule.max_steps:
                self.guard.restart()  # losses at the resolution and rates of another schedule
        device = self.scene.surfels["means"].device  # a checkpoint is read on the CPU
        self.exposure.load_state_dict(state.get("exposure"), len(self._full_size), device)
        self.poses.load_state_dict(state.get("poses"))
        if "step_sizes" in state:
            self.step_sizes.load_state_dict(state["step_sizes"], device)
        self.clock = Stopwatch(state["seconds"], state["cpu_seconds"])


class Stopwatch:
    """Wall-clock and CPU seconds of the training steps."""

    def __init__(self, seconds: float = 0.0, cpu_seconds: float = 0.0) -> None:
        self.seconds = seconds
        self.cpu_seconds = cpu_seconds
        self._started: tuple[float, float] | None = None

    def start(self) -> None:
        self._started = (time.perf_counter(), time.process_time())

    def stop(self) -> None:
        if self._started is not None:
            self.seconds += time.perf_counter() - self._started[0]
            self.cpu_seconds += time.process_time() - self._started[1]
            self._started = None
