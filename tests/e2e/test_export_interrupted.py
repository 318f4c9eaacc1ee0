"""Ctrl-C in an export: nothing is left half-written, and the message says what is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bitymi_ns.bake import learn as bake_learn
from bitymi_ns.bake import tune
from bitymi_ns.bundle import check_files
from bitymi_ns.plugin.export import command
from bitymi_ns.plugin.run.config import BitymiTrainerConfig
from tests.e2e.exports import TOLERANCE, run_export


def test_ctrl_c_in_the_fine_tuning_leaves_nothing(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tune, "photometric", interrupted)
    with pytest.raises(SystemExit) as stop:
        run_export(trained, tmp_path / "b", tolerance=TOLERANCE)
    assert stop.value.code == 130 and list(tmp_path.iterdir()) == []


def test_ctrl_c_in_the_export_leaves_nothing(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(bake_learn, "learned", interrupted)
    with pytest.raises(SystemExit) as stop:
        run_export(trained, tmp_path / "b")
    assert stop.value.code == 130
    assert "was not written" in " ".join(capsys.readouterr().out.split())
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_before_a_bundle_is_replaced_says_which_one_is_there(
    trained: BitymiTrainerConfig, copied: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(bake_learn, "learned", interrupted)
    with pytest.raises(SystemExit):
        run_export(trained, copied, overwrite=True)
    assert "is the earlier one" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("call", "name", "state"),
    [
        ("mkdir", ".elsewhere.new", "is the earlier one"),  # the new one is begun
        ("rename", "elsewhere", "is the earlier one"),  # the earlier one is out of the way
        ("rename", ".elsewhere.new", "is complete"),  # the new one is in its place
    ],
)
def test_ctrl_c_while_a_bundle_is_replaced_says_which_one_is_there(
    trained: BitymiTrainerConfig,
    copied: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    call: str,
    name: str,
    state: str,
) -> None:
    before = (copied / "bundle.json").read_bytes()
    do = getattr(Path, call)

    def interrupted_after(self: Path, *arguments: Any, **options: Any) -> Any:
        result = do(self, *arguments, **options)
        if self.name == name:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(Path, call, interrupted_after)
    with pytest.raises(SystemExit):
        run_export(trained, copied, overwrite=True, r_max=8, compare=False, finetune_steps=0)
    monkeypatch.undo()
    assert state in " ".join(capsys.readouterr().out.split())
    assert ((copied / "bundle.json").read_bytes() == before) == (state == "is the earlier one")
    assert check_files(copied)[0] is not None and [p.name for p in copied.parent.iterdir()] == [copied.name]


def test_ctrl_c_in_the_comparison_says_that_the_bundle_is_complete(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "read_bundle", interrupted)
    with pytest.raises(SystemExit):
        run_export(trained, tmp_path / "b", finetune_steps=0)
    assert "is complete" in " ".join(capsys.readouterr().out.split())
    assert check_files(tmp_path / "b")[0] is not None
