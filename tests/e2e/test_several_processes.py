"""Runs of two processes on the CPU, by `--machine.num-devices 2` and torchrun: results, resuming, the loss of one."""

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.plugin.run.config import BitymiTrainerConfig
from tests.e2e.conftest import small_run
from tests.e2e.runs import Start, checkpoint, different

pytestmark = pytest.mark.slow
STEPS = 30
TRAIN = "import pickle, sys; from nerfstudio.scripts import train; train.main(pickle.load(open(sys.argv[1], 'rb')))"
Run = subprocess.Popen[str]


def two(config: BitymiTrainerConfig) -> BitymiTrainerConfig:
    config.machine.num_devices, config.max_num_iterations, config.steps_per_save = 2, STEPS, STEPS // 3
    return config


def started(config: BitymiTrainerConfig, by: tuple[str, ...] = ()) -> Run:
    file = config.output_dir.with_name(f"{config.timestamp}.pickle")
    file.write_bytes(pickle.dumps(config))
    command = [*by, sys.executable, "-c", TRAIN, str(file)]
    threads = {"OMP_NUM_THREADS": "1" if by else "2"}  # one of each process, as torchrun does not divide them
    return subprocess.Popen(
        command, env={**os.environ, **threads}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_for(file: Path, run: Run, lines: int = 0) -> None:
    while not file.exists() or (lines and len(file.read_text().splitlines()) < lines):
        assert run.poll() is None, run.communicate()[1]
        time.sleep(0.02)


def process_of(run: Run, rank: int) -> psutil.Process:
    ranks: Iterator[psutil.Process] = (
        child for child in psutil.Process(run.pid).children(recursive=True) if child.environ().get("RANK") == str(rank)
    )
    return next(ranks)


@pytest.fixture(scope="module")
def pair(room: Path, tmp_path_factory: pytest.TempPathFactory) -> BitymiTrainerConfig:
    """A finished run of two processes with the checkpoints of all steps. Not to be changed."""
    config = two(small_run(room, tmp_path_factory.mktemp("runs") / "outputs"))
    config.save_only_latest_checkpoint, config.steps_per_save = False, 1
    run = started(config)
    said, errors = run.communicate()
    assert run.returncode == 0, errors
    assert said.count(f"step     {STEPS} of {STEPS}") == said.count("of 12 photographs") == 1
    return config


def test_two_processes_leave_the_run_of_one(pair: BitymiTrainerConfig) -> None:
    folder = pair.get_base_dir()
    assert sorted(p.name for p in folder.iterdir()) == [
        "config.yml", "dataparser_transforms.json", "nerfstudio_models", FILE
    ]  # fmt: skip
    points = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert [p["step"] for p in points] == [10, 20, STEPS]
    config, pipeline, _, step = eval_setup(folder / "config.yml")
    assert step == STEPS - 1 and config.machine.num_devices == 2
    metrics = pipeline.get_average_eval_image_metrics()
    assert metrics["psnr"] == pytest.approx(points[-1]["psnr"], abs=1e-3)


def test_a_run_that_lost_a_process_goes_on_alike_until_ctrl_c(pair: BitymiTrainerConfig, start: Start) -> None:
    lost, resumed = two(start(name="lost")), two(start(name="resumed"))
    run = started(lost)
    wait_for(lost.get_checkpoint_dir() / "step-000000010.ckpt", run)
    process_of(run, 1).kill()
    errors = run.communicate()[1].splitlines()
    assert run.returncode == 1 and errors[-1].startswith("bitymi: process 2 of the 2 of this run was ended by SIGKILL")
    told = [line for line in errors if any(w in line for w in ("Traceback", "torch.distributed", "Root Cause", "WARN"))]
    assert told == [], "\n".join(errors)
    resumed.load_dir, resumed.steps_per_save = lost.get_checkpoint_dir(), 1000  # so that only Ctrl-C saves
    run = started(resumed)
    wait_for(resumed.get_base_dir() / FILE, run, lines=2)
    run.send_signal(signal.SIGINT)
    said, errors = run.communicate()
    assert run.returncode == 130 and "Traceback" not in errors
    assert "Stopping after this step" in said and f"--load-dir {resumed.get_checkpoint_dir()}" in said
    (saved,) = resumed.get_checkpoint_dir().iterdir()
    step = int(saved.stem.removeprefix("step-"))
    assert different(checkpoint(pair, step), checkpoint(resumed, step)) == []


def test_what_is_wrong_is_said_once(start: Start, tmp_path: Path) -> None:
    config = two(start(name="nowhere"))
    config.load_dir = tmp_path
    run = started(config)
    errors = run.communicate()[1]
    assert run.returncode == 1 and errors.count("bitymi:") == 1 and str(tmp_path) in errors.splitlines()[-1]
    assert "SIGTERM" not in errors  # of the process that had waited


def test_torchrun_starts_a_run_on_two_machines(pair: BitymiTrainerConfig, start: Start) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    configs = [two(start(name=f"machine-{rank}")) for rank in range(2)]
    configs[1].max_num_iterations = 1  # the first states what is done
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--rdzv-endpoint", address)
    runs = [
        started(config, (*torchrun, "--node-rank", str(rank), "--no-python")) for rank, config in enumerate(configs)
    ]
    (said, errors), (silent, others) = (run.communicate() for run in runs)
    assert [run.returncode for run in runs] == [0, 0], errors + others
    assert "step     30 of 30" in said and not silent.strip() and not configs[1].get_base_dir().exists()
    assert different(checkpoint(pair, STEPS - 1), checkpoint(configs[0], STEPS - 1)) == []
