"""Train in nerfstudio's loop with exact resumption, whole checkpoints and an orderly end on Ctrl-C."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
import torch.distributed as dist
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns import exit_messages, files
from bitymi_ns.safe_reading import reading
from bitymi_ns.train import optimizers
from bitymi_ns.train.processes import ProcessesApart, ProcessLost
from ..console import INTERRUPTED, InputError, fail, say, step_bar, warn
from ..data.cameras import to_cameras
from ..data.dataset import capture_fingerprint, warn_of_other_capture
from ..hooks import print_brackets
from . import checkpoints, folder_lock, torchrun
from .checkpoint_schema import Entry, restore_optimizer
from .model import BitymiModel

if TYPE_CHECKING:
    from torch.cuda.amp.grad_scaler import GradScaler

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, a batch system, a terminal that is gone
AGAIN = 1.0  # seconds within which signals are one: torchrun passes on a batch system's


class _StopAfterStep(Exception):
    """Ends training after a step."""


class TogetherOptimizers(Optimizers):
    """nerfstudio's optimisers, one per parameter group, stepped together, which is faster. `combine` is called before
    each step and returns the factors of `optimizers.step`."""

    def __init__(
        self, config: dict[str, Any], groups: dict[str, list[Parameter]], combine: Callable[[], Mapping[str, Tensor]]
    ) -> None:
        super().__init__(config, groups)
        self.combine = combine

    def zero_grad_some(self, param_groups: list[str]) -> None:
        optimizers.forget_gradients(self.optimizers[group] for group in param_groups)

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        factors = self.combine()
        for group in param_groups:
            longest = self.config[group]["optimizer"].max_norm
            if longest is not None:
                torch.nn.utils.clip_grad_norm_(self.parameters[group], longest)
        optimizers.step({group: self.optimizers[group] for group in param_groups}, factors)


class BitymiTrainer(Trainer):
    """Trainer to a total number of steps, as of uninterrupted runs. Every process has one; they train in step."""

    config: Any  # nerfstudio declares those of every method
    pipeline: Any

    def __init__(self, config: TrainerConfig, **alone: Any) -> None:
        here = torchrun.own("LOCAL_")  # nerfstudio passes rank 0 of 1
        with print_brackets():
            super().__init__(config, here.rank, here.count)
        self.processes = torchrun.own()

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        self._stop_requested = 0.0  # time of the first signal; 0 = none
        try:
            with print_brackets():
                super().setup(test_mode)
        except KeyboardInterrupt:  # else a traceback and status 0
            CONSOLE.print("[bold yellow]Interrupted before the first step; there is nothing to save.")
            raise SystemExit(INTERRUPTED) from None
        facts = self.pipeline.datamanager.train_dataset.facts
        folder_lock.keep_poses_report(self.base_dir, facts.poses_report, facts.poses_found)
        for line in getattr(self.viewer_state, "viewer_info", []):
            CONSOLE.print(line, soft_wrap=True)
        # last callback of a step, where the state is complete
        self.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._end_of_step))

    def setup_optimizers(self) -> Optimizers:
        groups = self.pipeline.get_param_groups()
        return TogetherOptimizers(self.config.optimizers.copy(), groups, lambda: self.pipeline.model.run.combine())

    def _end_of_step(self, step: int) -> None:
        self._show_step(step, self.pipeline.model.seconds_left)
        if self.processes.any(self._stop_requested > 0):
            raise _StopAfterStep

    def _load_checkpoint(self) -> None:
        config = self.config
        if config.load_dir is not None or config.load_checkpoint is not None:
            if config.load_dir is not None:
                step = config.load_step if config.load_step is not None else checkpoints.newest_step(config.load_dir)
                path = checkpoints.path_of(config.load_dir, step)
            else:
                path = Path(config.load_checkpoint)
            if self.processes.first:
                files.remove_unfinished(path.parent.parent)  # left by a killed run
            self._restore(checkpoints.load(path, config.pipeline.model.scene), path)
            say(f"Resuming after step {self._start_step - 1} from {path}")
        config.resolve_length(getattr(self.pipeline.model, "trained_for", None))

    def _restore(self, state: dict[str, Any], path: Path) -> None:
        self._start_step = state["step"] + 1
        self.pipeline.load_pipeline(state["pipeline"], state["step"])
        with reading(f"{path} cannot be resumed: the state of its optimisers", InputError, "Train again."):
            for name, saved in state["optimizers"].items():
                restore_optimizer(self.optimizers.optimizers[name], Entry(saved, f"optimizers.{name}"))
            if "schedulers" in state and self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])

    def train(self) -> None:
        """Train to step `max_num_iterations`; nerfstudio trains that many more in a resumed run."""
        orderly = False
        try:
            if self.processes.count > 1 and self.processes.first:
                torchrun.join(self.config)
            self._train_to_the_end()
            orderly = True
        except ProcessLost as error:
            fail(str(error), error)
        except ProcessesApart as error:
            fail(f"training cannot go on at step {self.step}: {error}.", error)
        finally:
            # a GPU that waits for a lost process would block this
            if dist.is_initialized() and (orderly or self.config.machine.device_type != "cuda"):
                dist.destroy_process_group()
            folder_lock.leave(self.base_dir)

    def _train_to_the_end(self) -> None:
        total = self.config.max_num_iterations
        if self._start_step >= total:
            warn(f"The checkpoint has {self._start_step:,} of {total:,} steps: give a larger --max-num-iterations.")
            return
        if self.processes.first:  # a checkpoint has each parameter and Adam's two moments
            learned = [p.nbytes for p in self.pipeline.parameters() if p.requires_grad]
            folder_lock.check_space(self.base_dir, 3 * sum(learned))
        if self._start_step > 0:
            say(f"{self.config.length()}, {total - self._start_step:,} of them left")
        previous = self._catch_interrupt()
        try:
            # nerfstudio's loop reads its length there
            self.config.max_num_iterations = total - self._start_step
            with print_brackets(), step_bar(self._start_step, total) as self._show_step:
                super().train()
        except _StopAfterStep:
            self.save_checkpoint(self.step)
            self._report_interruption()
        except KeyboardInterrupt:
            if self.training_state != "completed":  # else only the viewer was left to quit
                self._report_interruption()
        finally:
            self.config.max_num_iterations = total
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _catch_interrupt(self) -> dict[int, Any]:
        """Let the first signal of STOPPING end the run after the current step; return the previous handlers."""
        if threading.current_thread() is not threading.main_thread():
            return {}
        previous: dict[int, Any] = {number: signal.getsignal(number) for number in STOPPING}
        if previous[signal.SIGHUP] == signal.SIG_IGN:  # by nohup
            del previous[signal.SIGHUP]

        def on_interrupt(number: int, frame: Any) -> None:
            now, before = time.monotonic(), self._stop_requested
            if self.training_state == "completed" or (before and now > before + AGAIN):
                raise KeyboardInterrupt
            self._stop_requested = before or now
            if number == signal.SIGINT:  # other signals are of a batch system or torchrun
                CONSOLE.print("\nStopping after this step and saving a checkpoint; Ctrl-C again stops at once.")

        for number in previous:
            signal.signal(number, on_interrupt)
        return previous

    def _report_interruption(self) -> None:
        warn(f"Training was interrupted. {checkpoints.how_to_resume(self.checkpoint_dir)}")
        raise SystemExit(INTERRUPTED)

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write a finished step's checkpoint, and only then remove older ones."""
        path = checkpoints.path_of(self.checkpoint_dir, step)
        pipeline = getattr(self.pipeline, "module", self.pipeline)
        state = {
            "step": step,
            "pipeline": pipeline.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.optimizers.items()},
            "schedulers": {name: s.state_dict() for name, s in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }
        checkpoints.save(state, path, self.base_dir, self.config.pipeline.model.scene)
        if self.config.save_only_latest_checkpoint:
            for earlier in self.checkpoint_dir.glob("step-*.ckpt"):
                if earlier.name < path.name:  # later ones are of another branch
                    earlier.unlink(missing_ok=True)


class BitymiPipeline(VanillaPipeline):
    datamanager: Any  # nerfstudio declares those of every method
    model: Any

    def __init__(self, *args: Any, world_size: int = 1, local_rank: int = 0, **kwargs: Any) -> None:
        # else nerfstudio would wrap the model in DistributedDataParallel
        super().__init__(*args, **kwargs)
        self.datamanager.world_size = world_size

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
        losses = self.model.run.losses(self.datamanager.train_index(step))
        return {}, losses, self.model.get_metrics_dict({}, {})

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        try:
            super().load_pipeline(loaded_state, step)
        except (RuntimeError, LookupError, TypeError, AttributeError) as error:
            if exit_messages.out_of_memory(error):
                raise
            fail(f"the checkpoint of step {step} does not fit this scene. {error}", error)
        if self.test_mode == "val" or not isinstance(self.model, BitymiModel):  # callbacks do this in training
            return
        state = self.model.resume_state
        held_out = to_cameras(self.datamanager.eval_dataset.cameras, "cpu")
        warn_of_other_capture(state.get("capture"), capture_fingerprint(self.datamanager.train_dataset))
        if (poses := state.get("poses")) is not None and poses["motions"] is not None:
            self.model.carry = self.datamanager.move_cameras(poses["motions"])
        _, corrections = self.datamanager.corrections(state.get("exposure"))
        if any(correction is not None for correction in corrections):
            self.model.corrections = list(zip(held_out, corrections, strict=True))

    def get_average_image_metrics(self, data_loader: Any, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Average the metrics over the images, leaving out those that are NaN, as JSON has no NaN; the deviation of a
        single image is 0."""
        if len(data_loader) == 0:
            fail("there is no held-out view: none was held out, or their masks exclude every pixel")
        metrics = super().get_average_image_metrics(data_loader, *args, **kwargs)
        missing = [k for k, v in metrics.items() if math.isnan(v) and not k.endswith("_std")]
        if missing:
            warn(f"{', '.join(missing)} is left out: no pixel of a held-out view counts.")
        kept = {k: v for k, v in metrics.items() if k.removesuffix("_std") not in missing}
        return {k: 0.0 if math.isnan(v) else v for k, v in kept.items()}


@dataclass
class BitymiPipelineConfig(VanillaPipelineConfig):
    _target: type = field(default_factory=lambda: BitymiPipeline)
