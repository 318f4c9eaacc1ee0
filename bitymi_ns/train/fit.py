"""Training loop without nerfstudio, for benchmarks and tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from .config import TrainConfig
from .evaluate import Quality, evaluate
from .init import scene_extent
from .optimizers import forget_gradients, make_optimizers, step
from .processes import ALONE, Processes
from .step import Training
from .views import TrainingData, View, covered_fraction, training_order

if TYPE_CHECKING:
    from bitymi_ns.ops.training_view import ComparedView
    from bitymi_ns.scene.scene import RenderOutput, Scene


@dataclass(kw_only=True)
class LogEntry(Quality):
    """State of a run after `step` steps, and quality of the evaluation views, with aligned poses after the last step
    alone."""

    step: int
    seconds: float  # Wall-clock time of training, without evaluation.
    cpu_seconds: float  # CPU time, likewise.
    surfels: int
    loss: float  # Objective of the last training step.


@dataclass
class TrainLog:
    entries: list[LogEntry] = field(default_factory=list)
    events: list[dict[str, float]] = field(default_factory=list)  # Reports of the strategy, with `step`.
    cameras: list[Camera] = field(default_factory=list)  # Training cameras, with refined poses if any.


class Trainer:
    """A training run, step by step.

    Attributes:
        training: the run.
        step: number of steps done.
        loss: objective of the last step; reading it synchronises a CUDA device.
    """

    def __init__(
        self,
        scene: Scene,
        views: Sequence[View],
        config: TrainConfig,
        max_steps: int,
        processes: Processes = ALONE,
    ) -> None:
        """
        Args:
            scene: changed in place.
            views: training views at full size.
            max_steps: length of the run; the schedules depend on it.
            processes: each is given the same scene and views.
        """
        if not views:
            raise ValueError("there is nothing to train on: no views")
        cameras, files = zip(*((view.camera, view.file) for view in views), strict=True)  # reads photographs once
        extent = scene_extent(torch.stack([camera.center for camera in cameras]), scene.surfels["means"])
        self.scene, self.config = scene, config
        self.optimizers = make_optimizers(scene)
        pixels = sum(camera.width * camera.height for camera in cameras)
        named = None if None in files else files
        data = TrainingData(views, cameras, extent, pixels, len(scene), covered_fraction(views), files=named)
        self.training = Training(scene, data, self.optimizers, config, max_steps, processes=processes)
        self.step = 0
        self._views = len(views)
        self._terms: list[Tensor] = []

    def advance(self) -> tuple[dict[str, Tensor], RenderOutput | ComparedView, dict[str, float]]:
        """Do a step; return the loss terms and render of its last view, and the strategy's report."""
        self.training.begin(self.step)
        forget_gradients(self.optimizers.values())
        for number in self.training.processes.view_numbers(self.step):
            view = self.training.view(training_order(self._views, self.config.seed, number))
            terms, output = self.training.losses(view)
            learning = [term for term in terms.values() if term.requires_grad]
            if learning:
                torch.autograd.backward(learning)
        step(self.optimizers, self.training.combine())
        report = self.training.finish()
        self._terms = [term.detach() for term in terms.values()]
        self.step += 1
        return terms, output, report

    @property
    def loss(self) -> float:
        return torch.stack(self._terms).sum().item() if self._terms else math.nan


def fit(
    scene: Scene,
    views: Sequence[View],
    eval_views: Sequence[View],
    config: TrainConfig,
    max_steps: int,
    callback: Callable[[Trainer], None] | None = None,
    eval_steps: Sequence[int] = (),
) -> TrainLog:
    """Train a scene in place.

    Args:
        views: training views at full size.
        callback: called after each step.
        eval_steps: numbers of steps after which an entry is logged, beside the last.
    """
    trainer = Trainer(scene, views, config, max_steps)
    clock, log = trainer.training.clock, TrainLog()
    due = {*eval_steps, max_steps}
    while trainer.step < max_steps:
        *_, report = trainer.advance()
        if report:
            log.events.append({"step": trainer.step - 1, **report})
        if trainer.step in due:
            trainer.training.watch.finish(scene)
            poses = trainer.training.poses if trainer.step == max_steps else None
            poses = poses if poses and poses.refined else None
            quality = evaluate(scene, eval_views, config, poses, trainer.training.exposure)
            costs = {"seconds": clock.seconds, "cpu_seconds": clock.cpu_seconds, "surfels": len(scene)}
            log.entries.append(LogEntry(step=trainer.step, loss=trainer.loss, **costs, **vars(quality)))
        if callback is not None:
            callback(trainer)
    log.cameras = [trainer.training.poses.of(i, view.camera) for i, view in enumerate(views)]
    return log
