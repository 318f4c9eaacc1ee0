"""Console output of a run: a few lines of its own, none of nerfstudio's about itself, nothing before the checks."""

import io
import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from nerfstudio.scripts import train as ns_train
from rich.console import Console

from bitymi_ns.capture import read as capture_read
from bitymi_ns.plugin import console
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import callbacks
from bitymi_ns.plugin.run.config import BitymiTrainerConfig, method_config
from bitymi_ns.train import forecast
from bitymi_ns.train.step import Training
from tests.typed import Patch, Printed


def run_on(capture: Path, output: Path) -> BitymiTrainerConfig:
    config = method_config("bitymi").config
    config.data, config.output_dir, config.experiment_name, config.timestamp = capture, output, "room", "run"
    config.vis, config.max_num_iterations, config.pipeline.model.curve_points = "none", 4, 2
    config.pipeline.model.scene.log2_table_size, config.pipeline.model.scene.min_resolution = 10, 16
    return config


def test_a_missing_capture_is_one_message(tmp_path: Path, capsys: Printed) -> None:
    config = run_on(tmp_path / "nowhere", tmp_path / "outputs")
    with pytest.raises(InputError, match="nowhere does not exist"):
        ns_train.main(config)
    printed = [line for line in capsys.readouterr().out.splitlines() if "Using --data alias" not in line]
    assert printed == []
    assert not (tmp_path / "outputs").exists()


def test_a_run_without_a_terminal_prints_reports(capture: Path, tmp_path: Path, capsys: Printed) -> None:
    config = run_on(capture, tmp_path / "outputs")
    config.vis = "tensorboard"
    ns_train.main(config)
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if line.strip()]
    assert f"capture  {capture}" in lines and "length   4 steps on cpu" in lines
    assert sum(line.startswith("step ") for line in lines) == 2
    assert "\r" not in printed and "\x1b" not in printed
    saved = yaml.load((tmp_path / "outputs/room/bitymi/run/config.yml").read_text(), Loader=yaml.Loader)
    assert saved.pipeline.model.train.densify.interval == 500 and saved.optimizers  # it is all there


def test_a_training_reads_its_capture_once(capture: Path, tmp_path: Path, monkeypatch: Patch, capsys: Printed) -> None:
    calls = {"recognise": 0, "read_transforms": 0, "as_meant": 0}

    def count(name: str, function: Any, *given: Any) -> Any:
        calls[name] += 1
        return function(*given)

    for name in calls:
        monkeypatch.setattr(capture_read, name, partial(count, name, getattr(capture_read, name)))
    config = run_on(capture, tmp_path / "outputs")
    ns_train.main(config)
    assert set(calls.values()) == {1} and capsys.readouterr().out.count("Reading ") == 1
    config.pipeline.datamanager.setup(device="cpu", test_mode="val")  # another data manager reads it as it is by then
    assert set(calls.values()) == {2}


def test_a_terminal_shows_a_bar_below_the_reports(monkeypatch: Patch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(console, "CONSOLE", Console(file=screen, force_terminal=True, width=80))
    with console.step_bar(10, 40) as show_step:
        show_step(15, None)
        show_step(19, 754.0)
        console.CONSOLE.print("a report")
    assert "20/40" in screen.getvalue() and "13 min left" in screen.getvalue() and "a report\n" in screen.getvalue()


@pytest.mark.parametrize(("seconds", "text"), [(99, "99 s"), (3000, "50 min"), (11_000, "3.1 h")])
def test_lengths_of_time(seconds: float, text: str) -> None:
    assert console.duration(seconds) == text


def test_a_long_run_says_when_it_will_end(capture: Path, tmp_path: Path, monkeypatch: Patch, capsys: Printed) -> None:
    monkeypatch.setattr(forecast, "WARM", 0)
    monkeypatch.setattr(forecast, "ENOUGH", 1)
    monkeypatch.setattr(callbacks, "SOON", 0)
    monkeypatch.setattr(forecast, "SURFEL", 0.001)
    monkeypatch.setattr(Training, "seconds_at", lambda self, factor: 1e6 * factor**2)
    ns_train.main(run_on(capture, tmp_path / "outputs"))
    printed = capsys.readouterr().out
    assert printed.count("The run will end in about ") == 1 and printed.index("will end") < printed.index("step ")
    assert re.search(r"at \d\d:\d\d; --pipeline.datamanager.longest-side 30 takes half as long\.", printed)
    assert re.search(r"step +2 of 4: .* left\n", printed) and not re.search(r"step +4 of 4: .* left\n", printed)


def test_names_do_not_control_the_terminal(capsys: Printed) -> None:
    console.say("a\x1b[2Jb [red]")
    console.warn("\x9b")
    assert (
        "a\\x1b[2Jb [red]" in (text := " ".join(capsys.readouterr().out.split()))
        and "\\x9b" in text
        and "\x9b" not in text
    )
    assert str(InputError("\x1b]0;x\x07")) == "bitymi: \\x1b]0;x\\x07"
