"""One training step, whichever loop it stands in: `fit` here, or nerfstudio's."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from bitymi_ns.train.clock import Stopwatch
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.errors import TrainingDiverged
from bitymi_ns.train.exposure import Exposure
from bitymi_ns.train.guard import Guard
from bitymi_ns.train.losses import objective
from bitymi_ns.train.optimizers import set_rate
from bitymi_ns.train.resize import ResizeHook
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.strategy import Strategy
from bitymi_ns.train.texels import LearningTexels
from bitymi_ns.train.views import ReducedViews, TrainingData, View, background_color
from bitymi_ns.train.watch import LossWatch

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import RenderOutput, Scene


def view_losses(
    scene: Scene, view: View, schedule: Schedule, step: int, config: TrainConfig, watch: LossWatch | None = None
) -> tuple[dict[str, Tensor], RenderOutput]:
    """Render a training view and compare it with its photograph.

    Args:
        scene: what is learned.
        view: on the scene's device, its picture at the size of its camera.
        schedule, step: which parts of the scene learn.
        config: training options.
        watch: looks at the losses of the run; without one a step waits until its own loss is known.

    Returns:
        The weighted terms of the loss (their sum is the objective), and the rendered view.

    Raises:
        TrainingDiverged: the loss is not finite.
    """
    device = scene.surfels["means"].device
    background = background_color(config.background, config.seed, step, device)
    output = scene.render(
        view.camera,
        background=background,
        field_mode="train" if schedule.field_trains(step) else "frozen",
        overdraw_half=config.loss.overdraw_half if schedule.overdraw_counts(step) else None,
        beta_alone=config.loss.falloff_weight > 0.0 and config.loss.falloff_gradient == "beta_only",
    )
    shown = output
    if view.correction is not None:
        shown = replace(output, rgb=view.shown(output.rgb, output.alpha, background), image=None)
    terms = objective(shown, view.target(background, device), config.loss, view.mask)
    own = watch or LossWatch()
    own.note(scene, step, terms)
    if watch is None:
        own.finish(scene)
    return terms, output


class Training:
    """What a training step needs beside the scene, and what it does. The order of a step:

    `begin` -> zero the gradients -> `losses` -> backward of their sum -> step of the optimisers -> `finish`.

    Attributes:
        step: index of the step that was begun last.
        schedule, strategy, guard, texels, watch: of the run.
        exposure: how the training photographs differ in their colours; decided when the first step begins.
        clock: time between `begin` and `finish`.
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
    ) -> None:
        """
        Args:
            scene: changed in place.
            data: what it is learned from.
            optimizers: one per surfel parameter, under its name, and those of the field.
            config: training options.
            max_steps: length of the run; the schedules depend on it.
            on_resize: told the name and the new Parameter after each replacement of a surfel parameter.
            announce: told in a sentence whenever the run goes back, or surfels are dropped.

        Raises:
            ValueError: a training option is out of its range.
        """
        self.scene, self.optimizers, self.config = scene, optimizers, config
        textured = scene.config.texture == "texels"
        self.schedule = Schedule(config, max_steps, data.extent, textured)
        self.schedule.reset_opacity()
        for name in optimizers:
            self.schedule.lr(name, 0)
        self.strategy = Strategy(config, self.schedule, data.extent, on_resize, data.image_pixels, data.first_surfels)
        self.exposure = Exposure(config.exposure, data.exif_stops)
        self.schedule.lr("exposure", 0)
        self.guard = Guard(scene, optimizers, self.strategy, self.schedule, config, announce, self.exposure)
        self.texels = LearningTexels(scene, self.schedule, config.texels)
        self.watch = LossWatch()
        self.clock = Stopwatch()
        self.step = 0
        self._full_size = data.views
        self._output: RenderOutput | None = None
        self._photometric = torch.tensor(math.nan)

    @functools.cached_property
    def views(self) -> ReducedViews:
        """The training views. Made at first use: on a card it takes a share of the memory that is free then."""
        return ReducedViews(self._full_size, self.scene.surfels["means"].device, self.exposure.of)

    def view(self, index: int) -> View:
        """Training view number `index`, as the step that was begun last wants it: on the device, reduced."""
        return self.views.at(index, self.schedule.resolution_factor(self.step))

    def begin(self, step: int) -> None:
        """Start the clock and set the learning rates of a step."""
        self.clock.start()
        self.step = step
        if not self.exposure.decided:
            self.exposure.start(self.scene.surfels["means"], self._full_size, self.scene.near)
        if self.texels.begin(step, self.views):
            self.guard.start_from_here()
        self.guard.before(step, self.views)
        self._set_rates()

    def _set_rates(self) -> None:
        for name, optimizer in self.optimizers.items():
            set_rate(optimizer, self.guard.factor * self.schedule.lr(name, self.step))

    def losses(self, view: View) -> tuple[dict[str, Tensor], RenderOutput]:
        """`view_losses` of the step's view. Where they are not finite, the guard mends the scene and it is drawn anew.

        Raises:
            TrainingDiverged: nothing can be mended, or it has been tried too often.
        """
        while True:
            self.texels.prepare(self.step, view, self.guard.factor)
            try:
                terms, output = view_losses(self.scene, view, self.schedule, self.step, self.config, self.watch)
            except TrainingDiverged as error:
                self.watch.forget()
                self.guard.failed(self.step, error)
                self._set_rates()
            else:
                self._output, self._photometric = output, terms["photometric"].detach()
                return terms, output

    def finish(self) -> dict[str, float]:
        """After the optimisers: densify, prune, look for divergence, stop the clock.

        Returns:
            What was done, by name; empty when nothing was due.

        Raises:
            TrainingDiverged: the run has gone back too often, or may not.
        """
        step, output = self.step, self._output
        assert output is not None, "a step is finished after its losses"
        self._output = None
        self.exposure.step(self.guard.factor * self.schedule.lr("exposure", step))
        if not self.schedule.densification_over(step):
            self.strategy.accumulate(output)
        broken = output.projection.broken
        del output  # with its fragments, before the strategy draws views of its own
        factor = self.schedule.resolution_factor(step)
        try:
            report = self.strategy.step(
                step, self.scene, self.optimizers, lambda k, generator: self.views.draw(k, generator, factor)
            )
        except TrainingDiverged as error:  # the optimisers broke the field or all surfels; no loss has shown it yet
            report = self.guard.failed(step, error)
        else:
            report |= self.guard.after(step, self._photometric, broken)
        if "rolled_back" in report:
            self.watch.forget()
        self.clock.stop()
        return report

    def state_dict(self) -> dict[str, Any]:
        """What decides, beside the scene and its optimisers, how the run goes on."""
        return {
            "strategy": self.strategy.state_dict(),
            "guard": self.guard.state_dict(),
            "exposure": self.exposure.state_dict(),
            "seconds": self.clock.seconds,
            "cpu_seconds": self.clock.cpu_seconds,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The inverse of `state_dict`."""
        self.strategy.load_state_dict(state["strategy"])
        if "guard" in state:  # checkpoints of earlier versions have none
            self.guard.load_state_dict(state["guard"])
        self.exposure.load_state_dict(state.get("exposure"), len(self._full_size))
        self.clock = Stopwatch(state["seconds"], state["cpu_seconds"])
