"""`ns-train --machine.num-devices 2` on the CPU: results, resuming, messages when a process ends."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch.distributed as dist
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.plugin.run.config import BitymiTrainerConfig
from bitymi_ns.plugin.run.trainer import BitymiTrainer
from tests.e2e.conftest import small_run
from tests.e2e.runs import Start, checkpoint, different

STEPS = 30


def two(config: BitymiTrainerConfig) -> BitymiTrainerConfig:
    """Configure the run for two processes, with checkpoints every third of its steps."""
    config.machine.num_devices, config.max_num_iterations, config.steps_per_save = 2, STEPS, STEPS // 3
    return config


def at_step(monkeypatch: pytest.MonkeyPatch, step: int, action: Any) -> None:
    """Run an action in the first process before a step."""
    iterate = BitymiTrainer.train_iteration

    def train_iteration(self: BitymiTrainer, current: int) -> Any:
        if current == step:
            action(self)
        return iterate(self, current)

    monkeypatch.setattr(BitymiTrainer, "train_iteration", train_iteration)


@pytest.fixture(scope="module")
def pair(room: Path, tmp_path_factory: pytest.TempPathFactory) -> BitymiTrainerConfig:
    """A finished run of two processes with all its checkpoints. Not to be changed."""
    config = two(small_run(room, tmp_path_factory.mktemp("outputs")))
    config.save_only_latest_checkpoint = False
    ns_train.main(config)
    return config


@pytest.mark.slow
def test_two_processes_leave_the_run_of_one(pair: BitymiTrainerConfig) -> None:
    folder = pair.get_base_dir()
    assert not dist.is_initialized()
    assert sorted(p.name for p in folder.iterdir()) == [
        "config.yml", "dataparser_transforms.json", "nerfstudio_models", FILE
    ]  # fmt: skip
    points = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert [p["step"] for p in points] == [10, 20, STEPS]
    config, pipeline, _, step = eval_setup(folder / "config.yml")
    assert step == STEPS - 1 and config.machine.num_devices == 2
    metrics = pipeline.get_average_eval_image_metrics()
    assert metrics["psnr"] == pytest.approx(points[-1]["psnr"], abs=1e-3)


@pytest.mark.slow
def test_a_run_that_lost_a_process_goes_on_bit_for_bit_alike_until_ctrl_c(
    pair: BitymiTrainerConfig, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost, resumed = two(start(name="lost")), two(start(name="resumed"))
    with monkeypatch.context() as patch:
        at_step(patch, 15, lambda trainer: trainer._workers._processes[0].kill())
        with pytest.raises(InputError, match="process 2 of the 2 of this run has ended: exit status -9"):
            ns_train.main(lost)
    assert [p.name for p in lost.get_checkpoint_dir().iterdir()] == ["step-000000010.ckpt"]
    assert not dist.is_initialized()
    resumed.load_dir, resumed.steps_per_save = lost.get_checkpoint_dir(), 1000  # so that only Ctrl-C saves
    at_step(monkeypatch, 20, lambda trainer: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(SystemExit) as stopped:
        ns_train.main(resumed)
    assert stopped.value.code == 130 and not dist.is_initialized()
    assert different(checkpoint(pair, 20), checkpoint(resumed, 20)) == []


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [("num_devices", 0, "num-devices must be at least 1"), ("num_machines", 2, "a run is of one machine, not 2")],
)
def test_machines_that_a_run_cannot_have(start: Start, option: str, value: int, message: str) -> None:
    config = start(name="machine")
    setattr(config.machine, option, value)
    with pytest.raises(InputError, match=message):
        ns_train.main(config)
