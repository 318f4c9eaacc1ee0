"""Configurations of the registered methods."""

import copy
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
import tyro
import yaml
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification
from torch.nn import Parameter
from torch.optim import Adam

from bitymi_ns import exit_messages
from bitymi_ns.capture.readings import WRITTEN
from bitymi_ns.capture.sfm_poses import has_kept_poses, kept_settings
from bitymi_ns.files import write_errors_as, write_file
from bitymi_ns.ranges import check_ranges
from bitymi_ns.train.optimizers import BETAS, EPS, FIELD_BETAS, adam
from bitymi_ns.train.preset import load_preset
from .. import hooks
from ..console import InputError, as_input_error, fail, say, warn
from ..data.capture_checks import check_capture, read_early
from ..data.datamanager import BitymiDataManagerConfig
from ..data.dataparser import BitymiDataParserConfig
from . import checkpoints, folder_lock, torchrun
from .device import has_cuda_kernels, why_not_cuda
from .model import PARAMETER_GROUPS, BitymiModelConfig
from .trainer import BitymiPipelineConfig, BitymiTrainer

SEEDS = 1 << 32  # end of numpy's range of seeds


@dataclass
class BitymiTrainerConfig(TrainerConfig):
    _target: type = field(default_factory=lambda: BitymiTrainer)
    read_from = None  # folder of an evaluated config.yml; no field, to stay out of config.yml
    vis: Literal[
        "none", "viewer", "wandb", "tensorboard", "comet", "viewer+wandb", "viewer+tensorboard", "viewer+comet",
        "viewer_legacy",
    ] = "viewer"  # fmt: skip
    """Visualizer; none = no viewer, and no log but the training curve."""
    max_num_iterations: int | None = None
    """Length of the run in steps; schedules scale with it. Not given: --default-iterations, or as before if resumed."""
    default_iterations: int = 30_000  # Steps on a GPU if --max-num-iterations is not given.
    default_iterations_cpu: int = 3_000
    """Steps without a supported GPU."""
    steps_per_save: int | None = None
    """Steps between checkpoints; not given: see --default-saves."""
    default_saves: int = 5  # Checkpoints of a run if --steps-per-save is not given.
    prompt: tyro.conf.Suppress[str | None] = None  # Of nerfstudio's text-to-scene methods.
    optimizers: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    """By parameter group; the rates come from --pipeline.model.train.lr."""

    if TYPE_CHECKING:  # nerfstudio declares another type
        pipeline: Any = None

    def __post_init__(self) -> None:
        """Refuse a command line with two captures: nerfstudio silently uses the first."""
        datamanager = self.pipeline.datamanager
        dataparser = getattr(datamanager, "dataparser", None)
        default = getattr(type(dataparser), "data", None)
        own = getattr(dataparser, "data", None)
        given = {
            "--data": self.data,
            "--pipeline.datamanager.data": getattr(datamanager, "data", None),
            "--data after the name of the parser": None if own == default else own,
        }
        stated = {option: path for option, path in given.items() if path is not None}
        if len({os.path.abspath(os.path.expanduser(path)) for path in stated.values()}) > 1:
            named = " and ".join(f"{path} ({option})" for option, path in stated.items())
            fail(f"two captures are given: {named}. Leave out one of them.")

    def set_timestamp(self) -> None:
        """Set timestamp, seeds, device and absolute paths before nerfstudio writes config.yml. If a run has several
        processes, start them and exit with them; in these, all but the first copy the first one's settings."""
        exit_messages.outlive_output()
        exit_messages.install(lambda: checkpoints.how_to_resume(self.get_checkpoint_dir()))
        if not torchrun.own().first:
            torchrun.join(self)
            return
        super().set_timestamp()
        if not 0 <= self.machine.seed < SEEDS:
            fail(f"--machine.seed must be from 0 to {SEEDS - 1}, not {self.machine.seed}")
        if several := torchrun.own().count > 1:
            machines, gpus = torchrun.own("GROUP_").count, torchrun.own("LOCAL_").count
            self.machine = replace(self.machine, num_machines=machines, num_devices=gpus)
        self._check_options()
        if not several and (self.machine.num_machines, self.machine.num_devices) != (1, 1):
            torchrun.run(self)
        if self.machine.seed != MachineConfig().seed:  # for seeds that are not given
            pipeline = self.pipeline
            for owner, name in ((pipeline.datamanager, "train_cameras_sampling_seed"), (pipeline.model.train, "seed")):
                if getattr(owner, name) == type(owner).__dataclass_fields__[name].default:
                    setattr(owner, name, self.machine.seed)
        if self.machine.device_type != "cpu" and (why := why_not_cuda()):
            warn(f"Training on the CPU instead of {self.machine.device_type}: {why}.")
            self.machine.device_type = "cpu"
        self._make_paths_absolute()
        self._take_poses_of_resumed()
        if self.load_dir is None and self.load_checkpoint is None:
            self.resolve_length()  # resumed runs take it from the checkpoint

    def _check_options(self) -> None:
        for options in (self.pipeline.model.scene, self.pipeline.model.train):
            try:
                check_ranges(options)
            except ValueError as error:
                fail(f"an option is out of range (--pipeline.model.*): {error}", error)
        model = self.pipeline.model
        checkpoints.check_removed("the configuration", vars(model.scene), vars(model.train.lr))
        for name in ("mixed_precision", "use_grad_scaler"):
            if getattr(self, name):
                fail(f"--{name.replace('_', '-')} True scales the gradients that densify surfels: leave it out")
        for group, steps in self.gradient_accumulation_steps.items():
            if steps < 1 or group not in PARAMETER_GROUPS:
                known = ", ".join(PARAMETER_GROUPS)
                fail(f"--gradient-accumulation-steps {group} {steps}: give at least 1 for one of {known}")
        asked, gpus = self.machine.num_devices, torch.cuda.device_count()
        if self.machine.device_type == "cuda" and has_cuda_kernels() and asked > gpus:
            fail(f"there are {gpus} of {asked} GPUs that --machine.num-devices asks for")

    def print_to_terminal(self) -> None:
        """Print nothing; `save_config` reports what matters."""

    def save_config(self) -> None:
        """Check capture and output folder, write config.yml, and print a summary."""
        if not torchrun.own().first:
            return
        check_capture(self.pipeline.datamanager)
        recorded, capture = self, read_early(self.pipeline.datamanager)
        if capture is not None:
            recorded = copy.deepcopy(self)
            recorded.pipeline.datamanager.dataparser.poses_as = capture.poses_as
        folder = self.get_base_dir()
        if self.load_dir is None and self.load_checkpoint is None:
            folder_lock.check_unused(folder, self.get_checkpoint_dir())
        folder_lock.take(folder)
        with write_errors_as(folder, InputError, " (--output-dir)."):
            write_file(folder / "config.yml", yaml.dump(recorded).encode("utf8"))
        # else nerfstudio would start the processes its own way
        self.machine = replace(self.machine, num_machines=1, num_devices=1)
        resumed = self.load_dir or self.load_checkpoint
        say(f"method   {self.method_name}\ncapture  {self.pipeline.datamanager.data}")
        say(f"length   {self.length() if resumed is None else f'goes on from {resumed}'}")
        say(f"output   {folder} (every option is in its config.yml)")

    def resolve_length(self, trained_for: int | None = None) -> None:
        """Set run length and save interval if not given; `trained_for`: length of the resumed run."""
        if self.max_num_iterations is None:
            default = self.default_iterations_cpu if self.machine.device_type == "cpu" else self.default_iterations
            self.max_num_iterations = trained_for or default
        if self.max_num_iterations < 1:
            fail(f"--max-num-iterations must be at least 1, not {self.max_num_iterations}")
        self.pipeline.model.steps = self.max_num_iterations
        if self.steps_per_save is None:
            self.steps_per_save = max(1, self.max_num_iterations // max(1, self.default_saves))

    def length(self) -> str:
        """Describe steps and device."""
        text = f"{self.max_num_iterations:,} steps on {self.machine.device_type}"
        if (count := torchrun.own().count) > 1:
            text += f", each on {count} views by as many processes"
        short = self.max_num_iterations == self.default_iterations_cpu != self.default_iterations
        if self.machine.device_type == "cpu" and short:
            why = "this installation has no kernels for the GPU" if torch.cuda.is_available() else "no GPU was found"
            text += f", a short run ({why}); for the full one: --max-num-iterations {self.default_iterations}"
        return text

    def _make_paths_absolute(self) -> None:
        datamanager = self.pipeline.datamanager
        if datamanager.data is None:  # given to the dataparser
            datamanager.data = getattr(datamanager.dataparser, "data", None)
        for owner in (self, datamanager, getattr(datamanager, "dataparser", None)):
            path = getattr(owner, "data", None)
            if owner is not None and path is not None:
                owner.data = Path(os.path.expanduser(path)).absolute()
        if isinstance(datamanager.dataparser, BitymiDataParserConfig):
            datamanager.dataparser.resolve_names()

    @as_input_error()
    def _take_poses_of_resumed(self) -> None:
        """Make a resumed run use the resumed one's poses, read in the same way; a new run finds its own."""
        checkpoints_of = self.load_dir or (None if self.load_checkpoint is None else Path(self.load_checkpoint).parent)
        if checkpoints_of is not None:
            run = Path(os.path.expanduser(checkpoints_of)).absolute().parent
            self.take_poses_of(run)
            dataparser = self.pipeline.datamanager.dataparser
            poses = getattr(dataparser, "poses", None)
            if poses is not None and has_kept_poses(Path(poses)):
                dataparser.sfm = kept_settings(Path(poses), dataparser.sfm)
            elif isinstance(dataparser, BitymiDataParserConfig) and (run / "config.yml").is_file():
                stated = re.search(r"^ *poses_as: (\S+)$", (run / "config.yml").read_text("utf8"), re.M)
                dataparser.poses_as = WRITTEN if stated is None else stated[1]
        elif isinstance(self.pipeline.datamanager.dataparser, BitymiDataParserConfig):
            self.pipeline.datamanager.dataparser.poses = None

    def take_poses_of(self, run: Path) -> None:
        """Make the dataparser read poses kept in the folder `run`, if any."""
        dataparser = self.pipeline.datamanager.dataparser
        if isinstance(dataparser, BitymiDataParserConfig) and has_kept_poses(run / folder_lock.POSES):
            dataparser.poses = run / folder_lock.POSES

    def is_viewer_enabled(self) -> bool:
        return self.vis != "none" and super().is_viewer_enabled()

    def get_checkpoint_dir(self) -> Path:
        """See `hooks.answer_checkpoint_dir`."""
        return hooks.answer_checkpoint_dir(self, super().get_checkpoint_dir)

    def get_base_dir(self) -> Path:
        """Return the run's folder; in evaluation, that of its config.yml, which may have been moved."""
        return super().get_base_dir() if self.read_from is None else self.read_from


@dataclass
class BitymiAdamConfig(OptimizerConfig):
    """Adam; the preset's schedule sets the learning rate at every step."""

    betas: tuple[float, float] = BETAS  # Decay of the running averages.

    def setup(self, params: list[Parameter]) -> Adam:
        """Create the optimiser as this torch can; another may have written config.yml."""
        return adam(params, self.betas, self.lr, self.eps)


def method_config(name: str) -> MethodSpecification:
    preset = load_preset(name)

    def optimizer(group: str) -> BitymiAdamConfig:
        return BitymiAdamConfig(lr=1e-3, eps=EPS, betas=FIELD_BETAS if group.startswith("field") else BETAS)

    config = BitymiTrainerConfig(
        method_name=preset.name,
        machine=MachineConfig(device_type="cuda" if has_cuda_kernels() else "cpu"),
        # the training curve replaces these
        **dict.fromkeys(("steps_per_eval_batch", "steps_per_eval_image", "steps_per_eval_all_images"), 0),
        mixed_precision=False,
        pipeline=BitymiPipelineConfig(
            datamanager=BitymiDataManagerConfig(dataparser=BitymiDataParserConfig()),
            model=BitymiModelConfig(scene=preset.scene, train=preset.train),
        ),
        # no scheduler: the model sets the rates
        optimizers={group: {"optimizer": optimizer(group), "scheduler": None} for group in PARAMETER_GROUPS},
        # a progress bar replaces the table
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False), profiler="none"),
        viewer=ViewerConfig(websocket_host=hooks.LOOPBACK, quit_on_train_completion=True),
    )
    return MethodSpecification(config=config, description=preset.description)
