"""Files and commands for a bare machine with a GPU."""

import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType


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
