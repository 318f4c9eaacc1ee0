"""Run training inside nerfstudio's loop: before, in and after a step; append the curve of progress."""

import errno
import json
import math
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns import exit_messages
from bitymi_ns.capture.image_files import exposure_stops
from bitymi_ns.files import reason, write_errors_as, write_file
from bitymi_ns.ops.backend import give_back_memory
from bitymi_ns.ranges import spread
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.visibility import views_without_surfels
from bitymi_ns.train import messages
from bitymi_ns.train.divergence import TrainingDiverged
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.forecast import Forecast, expected_surfels
from bitymi_ns.train.init import scene_extent
from bitymi_ns.train.step import Training
from bitymi_ns.train.views import OnDemand, TrainingData, covered_fraction
from bitymi_ns.trust import json_of, no_links
from ..console import InputError, duration, fail, listed, say, warn
from ..data.cameras import to_camera
from ..data.dataset import capture_fingerprint, warn_of_other_capture
from .memory import state_training

SOON = 60  # seconds; shorter runs do not state their end


class TrainingRun:
    """Link between `Training` and nerfstudio's loop: `before` -> `losses` -> backward -> `combine` -> optimisers ->
    `after`."""

    def __init__(self, model: Any, attributes: TrainingCallbackAttributes) -> None:
        trainer: Any = attributes.trainer  # nerfstudio declares another type
        pipeline: Any = attributes.pipeline
        optimizers: Any = attributes.optimizers
        self.scene = model.scene
        self.config = model.train_config
        self._curve_views = model.config.curve_views
        scene, config, curve_points = self.scene, self.config, model.config.curve_points
        self.datamanager: Any = pipeline.datamanager
        self.total: int = trainer.config.max_num_iterations
        self.first_step: int = trainer._start_step
        self._parameters = optimizers.parameters
        dataset = self.datamanager.train_dataset
        views = self.datamanager.train_views
        facts = model.facts
        train = dataset.cameras
        extent = scene_extent(facts.camera_centers, scene.surfels["means"])
        cameras = OnDemand(len(train), lambda i: to_camera(train[i : i + 1], "cpu"))
        counts = (facts.train_pixels, model.first_surfels, covered_fraction(views))
        data = TrainingData(views, cameras, extent, *counts, exposure_stops(facts.files), facts.files)
        processes, groups = trainer.processes, optimizers.optimizers
        self.training = Training(scene, data, groups, config, self.total, self._on_resize, warn, processes)
        self.combine = self.training.combine
        self.capture = capture_fingerprint(dataset)
        self._random_state: Tensor | None = None
        if resume_state := model.resume_state:
            self.training.load_state_dict({"max_steps": model.trained_for, **resume_state})
            self._random_state = resume_state["random"]
            warn_of_other_capture(resume_state.get("capture"), self.capture)
        # steps of the curve's points: evenly spaced, with the last one
        self.curve_steps = {max(0, round(self.total * (i + 1) / curve_points) - 1) for i in range(curve_points)}
        resumed_from = trainer.config.load_dir or getattr(trainer.config.load_checkpoint, "parent", None)
        self.curve = TrainingCurve(
            trainer.base_dir / FILE, None if resumed_from is None else resumed_from.parent / FILE, self.first_step
        )
        self.names = {"experiment_name": trainer.config.experiment_name, "method_name": trainer.config.method_name}
        self._end_said = False
        self._held_back = False  # a warning said that densification met its bound
        for sentence in (
            *messages.other_options(model.recorded_options, config),
            *messages.short_run(self.training.schedule, len(train), scene.config.texture == "hash", processes.views),
        ):
            say(sentence)
        _ = self.datamanager.cached_train  # read images now: loading is not training time
        if self.curve_steps:
            _ = self.datamanager.cached_eval
        self.datamanager.check_pictures()
        if self.first_step == 0:
            self._check_start()
        learns = scene.config.texture == "texels"
        texels = config.texels if learns else None
        to_come = self.training.texels.views_to_come
        pixels = [camera.width * camera.height for camera in cameras]
        schedule = self.training.schedule
        mean = sum(pixels) / len(pixels)
        surfels = expected_surfels(schedule, model.first_surfels, mean, self.training.strategy.most)
        lists = schedule.config.loss.overdraw_weight > 0.0
        most = max(len(scene), int(surfels[self.first_step :].max(initial=0)))
        state_training(scene, cameras, most, texels, to_come, trainer.world_size, lists)
        held_out = len(self.datamanager.eval_dataset)
        at_once = min(held_out, self._curve_views or held_out)
        evaluated = {step: held_out if step + 1 >= self.total else at_once for step in self.curve_steps}
        on_gpu = scene.surfels["means"].is_cuda
        self.forecast = Forecast(schedule, len(pixels), mean, surfels, evaluated, self.first_step, on_gpu)
        self._longest_side = max(max(camera.width, camera.height) for camera in cameras)

    def _compare_sizes(self, step: int) -> None:
        """Measure what a step takes at the sizes of pictures to come."""
        schedule = self.training.schedule
        sizes = {schedule.resolution_factor(later) for later in range(step, self.total)}
        if len(sizes) < 2 or self.scene.surfels["means"].is_cuda:
            return
        try:
            self.forecast.compare_sizes(step, {size: self.training.seconds_at(size) for size in sorted(sizes)})
        except (TrainingDiverged, MemoryError, RuntimeError) as error:  # only a run's own steps end it
            if not isinstance(error, TrainingDiverged) and not exit_messages.out_of_memory(error):
                raise
        give_back_memory()

    def _say_end(self, step: int) -> None:
        """Say once when the run will end, and what would halve its time."""
        if self._end_said or not self.forecast.settled:
            return
        self._end_said = True
        self._compare_sizes(step)
        left = self.forecast.left
        if left is None or left < SOON:
            return
        when = time.strftime("%H:%M" if left < 20 * 3600 else "%Y-%m-%d %H:%M", time.localtime(time.time() + left))
        side = 0 if self.scene.surfels["means"].is_cuda else 10 * int(self.forecast.half() * self._longest_side / 10)
        half = f"; --pipeline.datamanager.longest-side {side} takes half as long" if side else ""
        say(f"The run will end in about {duration(left)}, at {when}{half}.")

    def _check_start(self) -> None:
        """Stop, or warn, if views see nothing of what training starts from."""
        dataset = self.datamanager.train_dataset
        cameras = [to_camera(dataset.cameras[i : i + 1]) for i in range(len(dataset))]
        empty = [dataset.image_filenames[i] for i in views_without_surfels(self.scene, cameras)]
        if len(empty) == len(dataset):
            fail(
                f"none of the {len(self.scene):,} initial points lies in any training view: they are in another frame "
                "than the poses, or the cameras look the other way (nerfstudio's axes are x right, y up, z back)."
            )
        if empty:
            warn(f"{listed(empty)} sees no initial point: the pose may be wrong, or the point cloud has none there.")

    def callbacks(self) -> list[TrainingCallback]:
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.before),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self.after),
        ]

    def state(self) -> dict[str, Any]:
        """Return the state, beside parameters and optimisers, that decides how a resumed run goes on."""
        return {**self.training.state_dict(), "random": torch.get_rng_state(), "capture": self.capture}

    def before(self, step: int) -> None:
        if self._random_state is not None:
            torch.set_rng_state(self._random_state)
            self._random_state = None
        self.forecast.begin()
        undecided, field = not self.training.exposure.decided, self.scene.field
        self.training.begin(step)
        if self.scene.field is not field:
            assert isinstance(self.scene.field, TexelField)
            say(f"From step {step} on every surfel has its own texels, {len(self.scene.field.texels):,} in all.")
        if undecided and (sentence := self.training.exposure.sentence):
            say(sentence)

    def losses(self, index: int) -> dict[str, Tensor]:
        """Compare a render of training view `index` with its photograph."""
        try:
            return self.training.losses(self.training.view(index))[0]
        except TrainingDiverged as error:
            self._diverged(error)

    def after(self, step: int) -> None:
        """Densify and prune; then stop the clock and note progress."""
        try:
            if step in self.curve_steps:
                self.training.watch.finish(self.scene)
            report = self.training.finish()
        except TrainingDiverged as error:
            self._diverged(error)
        most = self.training.strategy.most
        if report.get("held_back") and not self._held_back and not self.training.by_memory:
            self._held_back = True
            warn(messages.held_back(int(report["held_back"]), most, self.config))
        if report:
            writer.put_dict("Strategy", {k: torch.tensor(float(v)) for k, v in report.items()}, step)
        if step in self.curve_steps:
            self._add_point(step)
        self.forecast.end(step)
        self._say_end(step)

    def _diverged(self, error: TrainingDiverged) -> NoReturn:
        fail(
            f"training cannot go on at step {self.training.step}: {error}. Earlier checkpoints are kept. Try lower "
            "learning rates (--pipeline.model.train.lr.*).",
            error,
        )

    def _on_resize(self, name: str, parameter: Parameter) -> None:
        self._parameters[name] = [parameter]  # used by gradient clipping

    def _add_point(self, step: int) -> None:
        views = self.datamanager.eval_views
        most = 0 if step + 1 >= self.total else self._curve_views
        rows = spread(len(views), most or len(views))
        refined = self.training.poses.refined and step + 1 >= self.total
        poses, exposure = self.training.poses if refined else None, self.training.exposure
        quality = evaluate(self.scene, OnDemand(len(rows), lambda i: views[rows[i]]), self.config, poses, exposure)
        clock = self.training.clock
        times = {"seconds": round(clock.seconds, 4), "cpu_seconds": round(clock.cpu_seconds, 4)}
        point = {"step": step + 1, **times, "surfels": len(self.scene), **self.training.by_memory}
        shown = ""
        if not math.isnan(quality.psnr):
            point |= {k: round(value, 4) for k, value in vars(quality).items() if not math.isnan(value)}
            shown = f"{quality.psnr:6.2f} dB held out, "
            if exposure.table is not None:
                shown += f"{quality.mean_exposure_psnr:.2f} dB with the mean exposure, "
            if refined:
                shown += f"{quality.carried_psnr:.2f} dB with their poses carried along, "
                shown += f"{quality.refined_psnr:.2f} dB with their poses refined, "
            writer.put_scalar("Held-out PSNR", torch.tensor(quality.psnr), step)
        self.curve.add({**point, **self.names})
        more = f"{shown}{point['surfels']:,} surfels, {self.training.clock.seconds:.0f} s of training"
        if self.forecast.left and step + 1 < self.total:
            more += f", {duration(self.forecast.left)} left"
        CONSOLE.print(f"step {step + 1:6,d} of {self.total:,}: {more}")


FILE = "training_curve.jsonl"


class TrainingCurve:
    """File of a run to which points are appended; a resumed run keeps those up to its checkpoint."""

    def __init__(self, path: Path, resumed_from: Path | None = None, steps_done: int = 0) -> None:
        self.path = path
        source = resumed_from if resumed_from is not None else path if steps_done > 0 else None
        with write_errors_as(path, InputError, "."):
            kept = []
            for line in source.read_text("utf8").splitlines() if source is not None and source.is_file() else ():
                with suppress(ValueError, KeyError, TypeError):  # cut off when the run was killed
                    if json_of(line)["step"] <= steps_done:
                        kept.append(line)
            write_file(path, "".join(line + "\n" for line in kept).encode("utf8"))

    def add(self, point: dict[str, Any]) -> None:
        """Write a point whole and at once; a full disk costs the point, not the run."""
        try:
            with open(self.path, "ab", buffering=0, opener=no_links) as file:
                line, kept = f"{json.dumps(point)}\n".encode(), file.tell()
                if file.write(line) < len(line):  # no point may follow half of one
                    file.truncate(kept)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            warn(f"A point of the training curve {self.path} could not be written: {reason(error, self.path)}.")
