"""A training run inside nerfstudio's loop: rates, rendering, losses, densification and the curve of progress."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns.host.cameras import to_camera
from bitymi_ns.host.curve import FILE, Stopwatch, TrainingCurve, points
from bitymi_ns.host.errors import fail
from bitymi_ns.host.metrics import psnr
from bitymi_ns.train.init import scene_extent
from bitymi_ns.train.losses import beta_only_map, falloff, photometric
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.strategy import Strategy
from bitymi_ns.train.views import View, as_float, background_color, over_background, reduce_image, reduce_mask

if TYPE_CHECKING:
    from bitymi_ns.host.model import BitymiModel


class TrainingRun:
    """What a training step needs beside the scene. Order of a step, by nerfstudio:

    `before` -> `render` -> `losses` -> backward -> optimisers -> `after`.
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
        self.schedule = Schedule(self.config, self.total, extent)
        self.strategy = Strategy(self.config, self.schedule, extent, self._on_resize)
        self.clock = Stopwatch()
        self._random_state: Tensor | None = None
        self._load(model.resume_state)
        self.curve_steps = points(self.total, model.config.curve_points)
        resumed_from = trainer.config.load_dir or getattr(trainer.config.load_checkpoint, "parent", None)
        self.curve = TrainingCurve(
            trainer.base_dir / FILE,
            None if resumed_from is None else resumed_from.parent / FILE,
            self.first_step - 1,
        )
        self.names = {
            "experiment_name": trainer.config.experiment_name,
            "method_name": trainer.config.method_name,
        }
        self._output: Any = None
        self._background: Tensor | None = None
        _ = self.datamanager.cached_train  # read the images now: loading is not training time

    def callbacks(self) -> list[TrainingCallback]:
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.before),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self.after),
        ]

    # state

    def state(self) -> dict[str, Any]:
        """Everything beside parameters and optimisers that decides how the run goes on."""
        return {
            "strategy": self.strategy.state_dict(),
            "random": torch.get_rng_state(),
            "seconds": self.clock.seconds,
            "cpu_seconds": self.clock.cpu_seconds,
        }

    def _load(self, state: dict[str, Any]) -> None:
        if not state:
            return
        self.strategy.load_state_dict(state["strategy"])
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
        for name, optimizer in self.optimizers.optimizers.items():
            rate = self.schedule.lr(name, step)
            for group in optimizer.param_groups:
                group["lr"] = rate

    def render(self, cameras: Cameras) -> dict[str, Any]:
        """Render the step's view at the resolution of the schedule."""
        camera = to_camera(cameras, self.model.device)
        factor = self.schedule.resolution_factor(self.step)
        if factor < 1.0:
            camera = camera.scaled(factor)
        self._background = background_color(self.config.background, self.config.seed, self.step, self.model.device)
        mode = "train" if self.schedule.field_trains(self.step) else "frozen"
        self._output = self.model.scene.render(camera, background=self._background, field_mode=mode)
        return {"rgb": self._output.rgb, "accumulation": self._output.alpha}

    def losses(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        """The photometric loss and, when it is on, the falloff loss."""
        output, loss = self._output, self.config.loss
        height, width = output.rgb.shape[:2]
        target, mask = self._target(batch, width, height)
        result = {"photometric": photometric(output.rgb, target, loss.ssim_weight, mask)}
        if loss.falloff_weight > 0.0:
            beta = output.beta
            if loss.falloff_gradient == "beta_only":
                beta = beta_only_map(output, self.model.scene.surfels["beta_raw"])
            value = falloff(output.rgb, target, beta, loss.falloff_gamma, loss.falloff_error, mask)
            result["falloff"] = loss.falloff_weight * value
        return result

    def _target(self, batch: dict[str, Any], width: int, height: int) -> tuple[Tensor, Tensor | None]:
        image = reduce_image(as_float(batch["image"].to(self.model.device)), width, height)
        mask = batch.get("mask")
        if mask is not None:
            mask = reduce_mask(mask.to(self.model.device), width, height)
        return over_background(image, self._background), mask

    def after(self, step: int) -> None:
        """Densify and prune; then, with the clock stopped, note how far the run has come."""
        fragments = int(self._output.fragments.weight.shape[0])
        if not self.schedule.densification_over(step):
            self.strategy.accumulate(self._output)
        self._output = None
        try:
            report = self.strategy.step(step, self.model.scene, self._surfel_optimizers(), self._draw_views)
        except ValueError as error:
            fail(f"training cannot go on after step {step}: {error}. Lower learning rates may help.", error)
        self.clock.stop()
        if report:
            writer.put_dict("Strategy", {k: torch.tensor(float(v)) for k, v in report.items()}, step)
        if step in self.curve_steps:
            self._add_point(step, fragments)

    def _surfel_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {name: self.optimizers.optimizers[name] for name in self.model.scene.surfels.keys()}

    def _on_resize(self, name: str, parameter: Parameter) -> None:
        self.optimizers.parameters[name] = [parameter]  # used by gradient clipping

    def _draw_views(self, count: int, generator: torch.Generator) -> list[View]:
        """Different training views at the current resolution; the order of training is not touched."""
        factor = self.schedule.resolution_factor(self.step)
        chosen = torch.randperm(len(self.datamanager.train_dataset), generator=generator)[:count].tolist()
        views = []
        for index in chosen:
            cameras, batch = self.datamanager.train_view(index)
            camera = to_camera(cameras, self.model.device).scaled(factor)
            image = reduce_image(as_float(batch["image"].to(self.model.device)), camera.width, camera.height)
            mask = batch.get("mask")
            if mask is not None:
                mask = reduce_mask(mask.to(self.model.device), camera.width, camera.height)
            views.append(View(camera, image, mask))
        return views

    # the curve

    def _add_point(self, step: int, fragments: int) -> None:
        point = {
            "step": step + 1,
            "seconds": round(self.clock.seconds, 4),
            "cpu_seconds": round(self.clock.cpu_seconds, 4),
            "surfels": len(self.model.scene),
            "fragments": fragments,
        }
        score = self._held_out_psnr(all_views=step + 1 >= self.total)
        if score is not None:
            point["psnr"] = round(score, 4)
            writer.put_scalar("Held-out PSNR", torch.tensor(score), step)
        self.curve.add({**point, **self.names})
        shown = "" if score is None else f"{score:6.2f} dB held out, "
        CONSOLE.print(
            f"step {step + 1:6,d} of {self.total:,}: {shown}{point['surfels']:,} surfels, "
            f"{self.clock.seconds:.0f} s of training"
        )

    @torch.no_grad()
    def _held_out_psnr(self, all_views: bool) -> float | None:
        """Mean PSNR over held-out views at full size."""
        count = len(self.datamanager.eval_dataset)
        if count == 0:
            return None
        limit = self.model.config.curve_views
        used = count if all_views or limit <= 0 else min(count, limit)
        background = self.model.background
        values = []
        for index in sorted({round(i * (count - 1) / max(1, used - 1)) for i in range(used)}):
            cameras, batch = self.datamanager.eval_view(index)
            camera = to_camera(cameras, self.model.device)
            rgb = self.model.render(camera, background, maps=False).rgb.clamp(0.0, 1.0)
            target = over_background(as_float(batch["image"].to(rgb.device)), background)
            mask = batch.get("mask")
            values.append(psnr(rgb * mask, target * mask, mask) if mask is not None else psnr(rgb, target))
        return sum(values) / len(values)
