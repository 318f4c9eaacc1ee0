"""A small trainer with torch alone, for benchmarks and tests; nerfstudio's loop calls the same parts."""

from __future__ import annotations

import copy
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.optim import Adam

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.config import AdamConfig, TrainConfig
from bitymi_ns.train.errors import TrainingDiverged, describe_broken
from bitymi_ns.train.guard import Guard
from bitymi_ns.train.init import scene_extent
from bitymi_ns.train.losses import mean_psnr, objective, psnr
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.strategy import Strategy
from bitymi_ns.train.views import (
    ReducedViews,
    View,
    as_float,
    at_size,
    background_color,
    over_background,
    training_order,
)

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import RenderOutput, Scene


@dataclass
class LogEntry:
    """The state of a run after `step` steps."""

    step: int
    seconds: float
    """Wall-clock time of training, without evaluation."""
    cpu_seconds: float
    """Processor time of training over all threads, without evaluation."""
    surfels: int
    fragments: float
    """Blended fragments a view, mean over the evaluation views."""
    loss: float
    """Of the last training step."""
    psnr: float
    """dB, mean over the evaluation views at full size; NaN without such views."""


@dataclass
class TrainLog:
    """What happened in a run."""

    entries: list[LogEntry] = field(default_factory=list)
    events: list[dict[str, float]] = field(default_factory=list)
    """Reports of the strategy, each with its `step`."""


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


def training_step(
    scene: Scene,
    camera: Camera,
    image: Tensor,
    mask: Tensor | None,
    schedule: Schedule,
    step: int,
    config: TrainConfig,
    watch: LossWatch | None = None,
) -> tuple[dict[str, Tensor], RenderOutput]:
    """Render a training view as the schedule asks for and compare it with its photograph.

    Args:
        scene: what is learned.
        camera: of the full-size image.
        image: [H, W, 3] or [H, W, 4] (straight alpha), at full size or at that of the step's resolution already.
        mask: [H, W] or [H, W, 1] bool at either size, True where the pixel counts; None = everywhere.
        schedule, step: resolution and freezing.
        config: training options.
        watch: of the run; without one a step waits until its own loss is known.

    Returns:
        The weighted terms of the loss (their sum is the objective), and the rendered view.

    Raises:
        TrainingDiverged: the loss is not finite.
    """
    factor = schedule.resolution_factor(step)
    device = scene.surfels["means"].device
    camera = camera.to(device)
    view = at_size(View(camera, image, mask), camera.scaled(factor) if factor < 1.0 else camera, device)
    background = background_color(config.background, config.seed, step, device)
    mode = "train" if schedule.field_trains(step) else "frozen"
    output = scene.render(
        view.camera,
        background=background,
        field_mode=mode,
        overdraw_half=config.loss.overdraw_half if schedule.overdraw_counts(step) else None,
        beta_alone=config.loss.falloff_weight > 0.0 and config.loss.falloff_gradient == "beta_only",
    )
    target = over_background(view.image, background)
    terms = objective(output, target, config.loss, view.mask)
    own = watch or LossWatch()
    own.note(scene, step, terms)
    if watch is None:
        own.finish(scene)
    return terms, output


def adam(parameters: list[torch.nn.Parameter], betas: tuple[float, float] = AdamConfig.betas) -> Adam:
    """Adam with the method's epsilon, fused where torch can do that on the parameters' device."""
    try:
        return Adam(parameters, lr=0.0, betas=betas, eps=AdamConfig.eps, fused=True)
    except RuntimeError:
        return Adam(parameters, lr=0.0, betas=betas, eps=AdamConfig.eps)


def make_optimizers(scene: Scene) -> dict[str, Adam]:
    """One optimiser a surfel parameter, under its name, and `field_table` and `field_mlp`."""
    optimizers = {name: adam([p]) for name, p in scene.surfels.items()}
    if scene.field is not None:
        table, *mlp = scene.field.weights
        optimizers["field_table"] = adam([table], AdamConfig.field_betas)
        optimizers["field_mlp"] = adam(mlp, AdamConfig.field_betas)
    return optimizers


class Trainer:
    """One training run, step by step.

    Attributes:
        step: number of steps done.
        seconds, cpu_seconds: time that training took, without evaluation.
        loss: objective of the last step; on a CUDA device, reading it waits for the step to end.
    """

    def __init__(
        self, scene: Scene, views: Sequence[View], config: TrainConfig, max_steps: int, extent: float | None = None
    ) -> None:
        """
        Args:
            scene: changed in place.
            views: training views at full size.
            config: training options.
            max_steps: length of the run; the schedules depend on it.
            extent: scene extent in world units; default: from the cameras.
        """
        if not views:
            raise ValueError("there is nothing to train on: no views")
        device = scene.surfels["means"].device
        if extent is None:
            centers = torch.stack([view.camera.center for view in views])
            extent = scene_extent(centers, scene.surfels["means"])
        self.scene = scene
        self.config = config
        self.views = ReducedViews(views, device)
        self.schedule = Schedule(config, max_steps, extent)
        pixels = sum(view.camera.width * view.camera.height for view in views)
        self.strategy = Strategy(config, self.schedule, extent, image_pixels=pixels)
        self.optimizers = make_optimizers(scene)
        self.guard = Guard(scene, self.optimizers, self.strategy, self.schedule, config)
        self.step = 0
        self.seconds = 0.0
        self.cpu_seconds = 0.0
        self.watch = LossWatch()
        self._loss = torch.tensor(math.nan)

    def advance(self) -> tuple[dict[str, Tensor], RenderOutput, dict[str, float]]:
        """Do one step: the terms of its loss, the rendered view, and what the strategy did after it."""
        start, cpu_start = time.perf_counter(), time.process_time()
        step, factor = self.step, self.schedule.resolution_factor(self.step)
        index = training_order(len(self.views), self.config.seed, step)
        camera, (_, image, mask) = self.views.camera(index), self.views.at(index, factor)
        self.guard.before(step, self.views)
        terms, output = None, None
        while terms is None:
            for name, optimizer in self.optimizers.items():
                optimizer.param_groups[0]["lr"] = self.guard.factor * self.schedule.lr(name, step)
                optimizer.zero_grad(set_to_none=True)
            try:
                terms, output = training_step(
                    self.scene, camera, image, mask, self.schedule, step, self.config, self.watch
                )
            except TrainingDiverged as error:
                self.watch.forget()
                self.guard.failed(step, error)
        total = torch.stack(list(terms.values())).sum()
        if total.requires_grad:
            total.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
        if not self.schedule.densification_over(step):
            self.strategy.accumulate(output)
        report = self.strategy.step(
            step, self.scene, self.optimizers, lambda k, generator: self.views.draw(k, generator, factor)
        )
        self._loss = total.detach()
        report |= self.guard.after(step, terms["photometric"].detach(), output.projection.broken)
        if "rolled_back" in report:
            self.watch.forget()
        self.step += 1
        self.seconds += time.perf_counter() - start
        self.cpu_seconds += time.process_time() - cpu_start
        return terms, output, report

    @property
    def loss(self) -> float:
        return self._loss.item()

    def state_dict(self) -> dict[str, Any]:
        """Everything that an exact resume needs: tensors, numbers and text only."""
        return {
            "step": self.step,
            "max_steps": self.schedule.max_steps,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "scene": {name: value.detach().clone() for name, value in self.scene.state_dict().items()},
            "optimizers": {name: copy.deepcopy(optimizer.state_dict()) for name, optimizer in self.optimizers.items()},
            "strategy": self.strategy.state_dict(),
            "guard": self.guard.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken; the run has the same options, views and length."""
        if state["max_steps"] != self.schedule.max_steps:
            raise ValueError(f"the run had {state['max_steps']} steps, this one has {self.schedule.max_steps}")
        self.scene.resize(len(state["scene"]["surfels.means"]))
        self.scene.load_state_dict(state["scene"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(copy.deepcopy(state["optimizers"][name]))
        self.strategy.load_state_dict(state["strategy"])
        self.guard.load_state_dict(state["guard"])
        self.step = state["step"]
        self.seconds, self.cpu_seconds = state["seconds"], state["cpu_seconds"]


@torch.no_grad()
def evaluate(scene: Scene, views: Sequence[View], config: TrainConfig) -> tuple[float, float]:
    """Mean PSNR in dB of the views at full size of which any pixel counts, and mean number of fragments per view; NaN
    without such views."""
    device = scene.surfels["means"].device
    # evaluation has one background, also when training draws a new one each step
    background = background_color("white" if config.background == "white" else "black", config.seed, 0, device)
    quality, fragments = [], []
    for camera, image, mask in views:
        output = scene.render(camera.to(device), background=background, field_mode="frozen")
        target = over_background(as_float(image.to(device)), background)
        quality.append(psnr(output.rgb.clamp(0.0, 1.0), target, None if mask is None else mask.to(device)))
        fragments.append(len(output.fragments))
        del output  # with its fragments, before the next view makes its own
    return mean_psnr(quality), sum(fragments) / len(fragments) if fragments else math.nan


def fit(
    scene: Scene,
    views: Sequence[View],
    eval_views: Sequence[View],
    config: TrainConfig,
    max_steps: int,
    callback: Callable[[Trainer, dict[str, Tensor], RenderOutput, dict[str, float]], None] | None = None,
    eval_steps: Sequence[int] = (),
    extent: float | None = None,
) -> TrainLog:
    """Train a scene in place.

    Args:
        scene: what is learned.
        views: training views at full size.
        eval_views: held-out views for the log.
        config: training options.
        max_steps: length of the run.
        callback: called after each step with the trainer, the loss terms, the view and the strategy's report.
        eval_steps: numbers of steps after which the log gets an entry; the end of the run always gets one.
        extent: scene extent in world units; default: from the cameras.
    """
    trainer = Trainer(scene, views, config, max_steps, extent)
    log = TrainLog()
    due = {*eval_steps, max_steps}
    while trainer.step < max_steps:
        terms, output, report = trainer.advance()
        if report:
            log.events.append({"step": trainer.step - 1, **report})
        if trainer.step in due:
            trainer.watch.finish(scene)
            quality, fragments = evaluate(scene, eval_views, config)
            times = (trainer.seconds, trainer.cpu_seconds)
            log.entries.append(LogEntry(trainer.step, *times, len(scene), fragments, trainer.loss, quality))
        if callback is not None:
            callback(trainer, terms, output, report)
    return log
