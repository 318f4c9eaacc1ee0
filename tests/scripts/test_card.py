"""Files and commands for a bare machine with a GPU."""

import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.mark.parametrize(("program", "status"), [("true", 0), ("false", 1)])
def test_nerfstudios_commands_are_tabled(
    load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, program: str, status: int
) -> None:
    times, page = load("times"), tmp_path / "page.md"
    monkeypatch.setattr(times, "tool", lambda name: program)
    assert times.nerfstudio(tmp_path / "fox", tmp_path / "runs", steps=4, output=page) == status
    assert page.read_text("utf8").count("| `ns-") == (0 if status else 6)


def test_wheels_are_parted_by_size(load: Callable[[str], ModuleType], tmp_path: Path) -> None:
    for name, size in {"a": 30, "b": 20, "c": 15, "d": 5, "e": 50}.items():
        (tmp_path / name).write_bytes(bytes(size))
    parts = load("card").parts(tmp_path, 45)
    assert [[file.name for file in part] for part in parts] == [["e"], ["a", "c"], ["b", "d"]]


def test_the_table_of_a_run_says_why_a_command_failed(load: Callable[[str], ModuleType], tmp_path: Path) -> None:
    card = load("card")
    for command, said in {"sys.exit('no card | none')": "1: no card / none", "print('well')": "0"}.items():
        step = card.Step("one", [sys.executable, "-c", f"import sys; {command}"], 60)
        line = card.run_step(step, tmp_path, dict(os.environ), tmp_path, time.monotonic() + 60)
        assert re.fullmatch(rf"\| one \| {said} \| \d+ \|", line)


def test_every_order_has_steps(load: Callable[[str], ModuleType], tmp_path: Path) -> None:
    card = load("card")
    (tmp_path / "fox").mkdir()
    (tmp_path / "fox/transforms.json").write_text("{}")
    assert all(card.steps_of(order, tmp_path, tmp_path) for order in card.ORDERS)
