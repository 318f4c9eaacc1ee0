"""Interrupted runs resume, and bad checkpoints are refused."""

import copy
import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.scripts import train as ns_train

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from bitymi_ns.plugin.run.trainer import BitymiTrainer
from bitymi_ns.train.step import Training
from tests.captures import edit
from tests.e2e.runs import Start, a_run_of, checkpoint, different
from tests.typed import Patch, Printed


@pytest.mark.parametrize("by", ["load_checkpoint", "load_dir"])
def test_a_resumed_run_ends_like_an_uninterrupted_one(trained: Run, start: Start, by: str) -> None:
    config = start(name="resumed")
    config.max_num_iterations = None  # the interrupted run's length
    if by == "load_checkpoint":
        config.load_checkpoint = trained.get_checkpoint_dir() / "step-000000020.ckpt"
    else:
        config.load_dir, config.load_step = trained.get_checkpoint_dir(), 20
    ns_train.main(config)
    assert different(checkpoint(trained, 59), checkpoint(config, 59)) == []
    steps = [json.loads(line)["step"] for line in (config.get_base_dir() / FILE).read_text().splitlines()]
    assert steps == [20, 40, 60]  # the first point is that of the interrupted run


@pytest.mark.slow
def test_a_finished_run_can_be_longer_an_interrupted_one_shorter(trained: Run, start: Start) -> None:
    for number, (step, length) in enumerate([(59, 150), (40, 45)]):
        config = start(name=f"length{number}")
        config.load_dir, config.load_step, config.max_num_iterations = trained.get_checkpoint_dir(), step, length
        config.steps_per_save = 7
        state = checkpoint(trained, step)  # of an earlier version: without the step at which texels began
        if number:
            del state["pipeline"]["_model._extra_state"]["run"]["texels_start"]
            config.load_dir, config.load_step = config.get_base_dir().parent / "earlier", None
            config.load_dir.mkdir(parents=True)
            torch.save(state, config.load_dir / f"step-{step:09d}.ckpt")
        ns_train.main(config)
        assert checkpoint(config, length - 1)["pipeline"]["_model._extra_state"]["run"]["texels_start"] == 36


def test_only_divergence_is_called_so(start: Start, monkeypatch: Patch) -> None:
    def wrong(self: Any, view: Any) -> None:
        raise ValueError("Trace.run: first has 951 elements, expected 1179")

    monkeypatch.setattr(Training, "losses", wrong)
    with pytest.raises(ValueError, match="expected 1179"):
        ns_train.main(start(name="wrong"))


def test_a_finished_run_is_not_touched_when_it_is_resumed(trained: Run, start: Start) -> None:
    config = start(name="again")
    config.load_dir = trained.get_checkpoint_dir()
    ns_train.main(config)
    assert not config.get_checkpoint_dir().exists()


def interrupt_at(monkeypatch: Patch, step: int, how: signal.Signals = signal.SIGINT) -> None:
    iterate = BitymiTrainer.train_iteration

    def train_iteration(self: BitymiTrainer, current: int) -> Any:
        if current == step:
            os.kill(os.getpid(), how)
        return iterate(self, current)

    monkeypatch.setattr(BitymiTrainer, "train_iteration", train_iteration)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_saves_what_was_learned(
    trained: Run, start: Start, monkeypatch: Patch, capsys: Printed, how: signal.Signals
) -> None:
    config = start(name="interrupted")
    handler = signal.getsignal(how)
    if handler == signal.SIG_IGN:  # these tests run under nohup
        pytest.skip(f"{how.name} is ignored")
    with monkeypatch.context() as patch:
        interrupt_at(patch, 27, how)
        with pytest.raises(SystemExit) as stop:
            ns_train.main(config)
    assert stop.value.code == 130
    assert signal.getsignal(how) is handler
    assert "--load-dir" in capsys.readouterr().out
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000027.ckpt"]
    resumed = start(name="resumed")
    resumed.load_dir = config.get_checkpoint_dir()
    ns_train.main(resumed)
    assert different(checkpoint(trained, 59), checkpoint(resumed, 59)) == []


def test_ctrl_c_while_the_capture_is_read(start: Start, monkeypatch: Patch) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    config = start(name="early")
    monkeypatch.setattr(type(config.pipeline), "setup", interrupted)
    with pytest.raises(SystemExit) as stop:
        ns_train.main(config)
    assert stop.value.code == 130


def test_a_branch_keeps_the_later_checkpoints(trained: Run, start: Start, tmp_path: Path) -> None:
    config = start(name="branch")
    shutil.copytree(trained.get_checkpoint_dir(), config.get_checkpoint_dir())
    config.load_dir, config.load_step, config.max_num_iterations = config.get_checkpoint_dir(), 20, 41
    config.steps_per_save = 100
    ns_train.main(config)
    assert [p.name for p in sorted(config.get_checkpoint_dir().iterdir())] == [
        "step-000000040.ckpt", "step-000000059.ckpt"
    ]  # fmt: skip


def test_resuming_on_another_capture(trained: Run, room: Path, start: Start, tmp_path: Path, capsys: Printed) -> None:
    def resumed(change: Callable[[dict[str, Any]], None], name: str) -> str:
        data = Path(shutil.copytree(room, tmp_path / name))
        edit(data, change)
        config = start(name=name, data=data)
        config.load_dir, config.load_step, config.max_num_iterations = trained.get_checkpoint_dir(), 59, 61
        capsys.readouterr()
        ns_train.main(config)
        return " ".join(capsys.readouterr().out.split())

    def moved(meta: dict[str, Any]) -> None:
        meta["frames"][3]["transform_matrix"][0][3] += 0.5

    assert "another capture" not in resumed(lambda meta: None, "same")
    assert "it had 10 training photographs, this one has 9" in resumed(lambda meta: meta["frames"].pop(), "fewer")
    assert "its cameras stand elsewhere" in resumed(moved, "moved")


def test_resuming_elsewhere_cleans_up_the_killed_run(trained: Run, start: Start, tmp_path: Path) -> None:
    killed = a_run_of(trained, tmp_path)
    (killed / ".step-000000060.ckpt.unfinished").write_text("half")
    config = start(name="resumed")
    config.load_dir = killed / "nerfstudio_models"
    ns_train.main(config)
    assert not [p.name for p in killed.iterdir() if p.name.startswith(".")]


def test_optimisers_that_do_not_fit_are_not_resumed(trained: Run, start: Start, tmp_path: Path) -> None:
    config = start()
    config.load_dir = tmp_path
    state = checkpoint(trained, 59)
    del state["optimizers"]["means"]["param_groups"]
    torch.save(state, config.load_dir / "step-000000059.ckpt")
    with pytest.raises(InputError, match="step-000000059.ckpt cannot be resumed.*optimizers.means.param_groups is mis"):
        ns_train.main(copy.deepcopy(config))
    state = checkpoint(trained, 59)
    state["optimizers"]["quats"]["state"][0]["exp_avg"] = torch.zeros(3)
    torch.save(state, config.load_dir / "step-000000059.ckpt")
    with pytest.raises(InputError, match="optimizers.quats.state.0.exp_avg has to be float32"):
        ns_train.main(config)
