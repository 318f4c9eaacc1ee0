"""A training run inside nerfstudio's loop: rates, rendering, losses, densification and the curve of progress."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns.host.cameras import to_camera
from bitymi_ns.host.curve import FILE, Stopwatch, TrainingCurve, points
from bitymi_ns.host.errors import fail, listed, warn
from bitymi_ns.host.memory import state_training
from bitymi_ns.train import bounds
from bitymi_ns.train.coverage import views_without_surfels
from bitymi_ns.train.errors import TrainingDiverged
from bitymi_ns.train.guard import Guard
from bitymi_ns.train.init import scene_extent
from bitymi_ns.train.losses import mean_psnr, psnr
from bitymi_ns.train.memory import OnDemand
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.strategy import Strategy
from bitymi_ns.train.trainer import LossWatch, training_step
from bitymi_ns.train.views import ReducedViews, View, as_float, over_background

if TYPE_CHECKING:
    from bitymi_ns.host.model import BitymiModel


class TrainingRun:
    """What a training step needs beside the scene. Order of a step, by nerfstudio:

    `before` -> `losses` -> backward -> optimisers -> `after`.
    """

    def __init__(self, model: BitymiModel, attributes: TrainingCallbackAttributes) -> None:
        trainer, pipeline = attributes.trainer, attributes.pipeline
        if trainer is None or pipeline is None or attributes.optimizers is None:
            raise ValueError("a training run needs nerfstudio's trainer, pipeline and optimisers")
        self.model = model
        self.config = model.train_config
        self.datamanager = pipeline.datamanager
        self.optimizers = attributes.optimizers
        self.total: int = trainer.config.max_num_iterations
        self.first_step: int = trainer._start_step
        self.step = self.first_step
        extent = scene_extent(model.metadata["camera_centers"], model.scene.surfels["means"])
        try:
            self.schedule = Schedule(self.config, self.total, extent)
            self.schedule.reset_opacity()
            for name in self.optimizers.optimizers:
                self.schedule.lr(name, 0)
        except ValueError as error:
            fail(f"a training option is out of range (--pipeline.model.train.*): {error}", error)
        pixels = model.metadata["train_pixels"]
        self.strategy = Strategy(self.config, self.schedule, extent, self._on_resize, pixels)
        self.watch = LossWatch()
        self.guard = Guard(
            model.scene, self.optimizers.optimizers, self.strategy, self.schedule, self.config, self._announce
        )
        self.clock = Stopwatch()
        self._random_state: Tensor | None = None
        self._load(model.resume_state)
        self.curve_steps = points(self.total, model.config.curve_points)
        resumed_from = trainer.config.load_dir or getattr(trainer.config.load_checkpoint, "parent", None)
        self.curve = TrainingCurve(
            trainer.base_dir / FILE,
            None if resumed_from is None else resumed_from.parent / FILE,
            self.first_step,
        )
        self.names = {
            "experiment_name": trainer.config.experiment_name,
            "method_name": trainer.config.method_name,
        }
        self._output: Any = None
        self._loss = torch.zeros(())
        self._held_back = False  # whether it was said that densification meets its bound
        for sentence in bounds.short_run(self.schedule, len(self.datamanager.train_dataset)):
            CONSOLE.print(sentence, soft_wrap=True)
        _ = self.datamanager.cached_train  # read the images now: loading is not training time
        if self.curve_steps:
            _ = self.datamanager.cached_eval
        self.datamanager.check_pictures()
        if self.first_step == 0:
            self._check_start()
        if model.device.type == "cpu":
            train = self.datamanager.train_dataset.cameras
            state_training(model.scene, OnDemand(len(train), lambda i: to_camera(train[i : i + 1])), self.strategy.most)
        views = OnDemand(len(self.datamanager.train_dataset), self._train_view)
        self.views = ReducedViews(views, model.device)

    def _check_start(self) -> None:
        """Stop, or warn, when views see nothing of what training starts from: no gradient would come from them."""
        dataset = self.datamanager.train_dataset
        cameras = [to_camera(dataset.cameras[i : i + 1]) for i in range(len(dataset))]
        blind = [dataset.image_filenames[i] for i in views_without_surfels(self.model.scene, cameras)]
        if len(blind) == len(dataset):
            fail(
                f"none of the {len(self.model.scene):,} points that training starts from lies in any training view: "
                "nothing could be learned. Either the point cloud is in another frame than the poses, or the cameras "
                "look the other way (nerfstudio's axes are x right, y up, z back)."
            )
        if blind:
            warn(
                f"{listed(blind)} sees none of the points that training starts from: the pose may be wrong, or the "
                "point cloud has no points there."
            )

    def callbacks(self) -> list[TrainingCallback]:
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.before),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self.after),
        ]

    def _train_view(self, index: int) -> View:
        cameras, batch = self.datamanager.train_view(index)
        return View(to_camera(cameras), batch["image"], batch.get("mask"))

    # state

    def state(self) -> dict[str, Any]:
        """Everything beside parameters and optimisers that decides how the run goes on."""
        return {
            "strategy": self.strategy.state_dict(),
            "guard": self.guard.state_dict(),
            "random": torch.get_rng_state(),
            "seconds": self.clock.seconds,
            "cpu_seconds": self.clock.cpu_seconds,
        }

    def _load(self, state: dict[str, Any]) -> None:
        if not state:
            return
        self.strategy.load_state_dict(state["strategy"])
        if "guard" in state:  # checkpoints of earlier versions have none
            self.guard.load_state_dict(state["guard"])
        self._random_state = state["random"]
        self.clock = Stopwatch(state["seconds"], state["cpu_seconds"])

    # a step

    def before(self, step: int) -> None:
        """Set the learning rates of the step."""
        self.clock.start()
        self.step = step
        if self._random_state is not None:
            torch.set_rng_state(self._random_state)
            self._random_state = None
        self.guard.before(step, self.views)
        self._set_rates()

    def _set_rates(self) -> None:
        for name, optimizer in self.optimizers.optimizers.items():
            rate = self.guard.factor * self.schedule.lr(name, self.step)
            for group in optimizer.param_groups:
                group["lr"] = rate

    def losses(self, cameras: Cameras, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Render the step's view at the resolution of the schedule and compare it with its photograph."""
        step, factor = self.step, self.schedule.resolution_factor(self.step)
        index = int(batch["image_idx"])
        camera, (_, image, mask) = self.views.camera(index), self.views.at(index, factor)
        arguments = (self.model.scene, camera, image, mask, self.schedule, step, self.config, self.watch)
        try:
            while True:
                try:
                    terms, self._output = training_step(*arguments)
                    break
                except TrainingDiverged as error:
                    self.watch.forget()
                    self.guard.failed(step, error)
                    self._set_rates()
        except TrainingDiverged as error:
            self._diverged(step, error)
        self._loss = terms["photometric"].detach()
        return terms

    def after(self, step: int) -> None:
        """Densify and prune; then, with the clock stopped, note how far the run has come."""
        scene, factor = self.model.scene, self.schedule.resolution_factor(step)
        if not self.schedule.densification_over(step):
            self.strategy.accumulate(self._output)
        broken = self._output.projection.broken
        self._output = None
        optimizers = {name: self.optimizers.optimizers[name] for name in scene.surfels.keys()}
        try:
            if step in self.curve_steps:
                self.watch.finish(scene)
            report = self.strategy.step(step, scene, optimizers, lambda k, g: self.views.draw(k, g, factor))
            report |= self.guard.after(step, self._loss, broken)
            if "rolled_back" in report:
                self.watch.forget()
        except ValueError as error:
            self._diverged(step, error)
        self.clock.stop()
        if report.get("held_back") and not self._held_back:
            self._held_back = True
            self._announce(bounds.held_back(int(report["held_back"]), self.strategy.most, self.config))
        if report:
            writer.put_dict("Strategy", {k: torch.tensor(float(v)) for k, v in report.items()}, step)
        if step in self.curve_steps:
            self._add_point(step)

    def _diverged(self, step: int, error: ValueError) -> NoReturn:
        fail(
            f"training cannot go on at step {step}: {error}. Earlier checkpoints are kept; lower learning rates "
            "(--pipeline.model.train.lr.*) may help.",
            error,
        )

    def _announce(self, text: str) -> None:
        CONSOLE.print(f"[bold yellow]{text}", soft_wrap=True)

    def _on_resize(self, name: str, parameter: Parameter) -> None:
        self.optimizers.parameters[name] = [parameter]  # used by gradient clipping

    # the curve

    def _add_point(self, step: int) -> None:
        quality = self._held_out(all_views=step + 1 >= self.total)
        point = {
            "step": step + 1,
            "seconds": round(self.clock.seconds, 4),
            "cpu_seconds": round(self.clock.cpu_seconds, 4),
            "surfels": len(self.model.scene),
        }
        shown = ""
        if quality is not None:
            point["psnr"], point["fragments"] = (round(value, 4) for value in quality)
            shown = f"{quality[0]:6.2f} dB held out, "
            writer.put_scalar("Held-out PSNR", torch.tensor(quality[0]), step)
        self.curve.add({**point, **self.names})
        CONSOLE.print(
            f"step {step + 1:6,d} of {self.total:,}: {shown}{point['surfels']:,} surfels, "
            f"{self.clock.seconds:.0f} s of training"
        )

    @torch.no_grad()
    def _held_out(self, all_views: bool) -> tuple[float, float] | None:
        """Mean PSNR and mean number of fragments over held-out views at full size; None where no pixel counts."""
        count = len(self.datamanager.eval_dataset)
        if count == 0:
            return None
        limit = self.model.config.curve_views
        used = count if all_views or limit <= 0 else min(count, limit)
        background = self.model.background
        values = []
        for index in sorted({round(i * (count - 1) / max(1, used - 1)) for i in range(used)}):
            cameras, batch = self.datamanager.eval_view(index)
            output = self.model.render(to_camera(cameras, self.model.device), background, maps=False)
            rgb = output.rgb.clamp(0.0, 1.0)
            target = over_background(as_float(batch["image"].to(rgb.device)), background)
            mask = batch.get("mask")
            values.append(
                (psnr(rgb, target, None if mask is None else mask.to(rgb.device)), float(len(output.fragments)))
            )
            del output  # with its fragments, before the next view makes its own
        quality, fragments = zip(*values, strict=True)
        mean = mean_psnr(quality)
        return None if math.isnan(mean) else (mean, sum(fragments) / len(fragments))
