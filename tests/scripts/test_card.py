"""Files and commands for a bare machine with a GPU."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType


def test_wheels_are_archived_in_parts(load: Callable[[str], ModuleType], tmp_path: Path) -> None:
    (tmp_path / "wheels").mkdir()
    (tmp_path / "wheels/a.whl").write_bytes(os.urandom(1_500_000))
    load("card").archive(tmp_path / "wheels", tmp_path / "stage", 1)
    parts = sorted((tmp_path / "stage").iterdir())
    subprocess.run(["tar", "-C", tmp_path, "-x"], input=b"".join(map(Path.read_bytes, parts)), check=True)
    assert len(parts) == 2 and (tmp_path / "a.whl").read_bytes() == (tmp_path / "wheels/a.whl").read_bytes()


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
