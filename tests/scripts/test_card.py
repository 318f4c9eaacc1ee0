"""Files and commands for a bare machine with a GPU."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

USE = """
import open3d.geometry
from gsplat.strategy import DefaultStrategy
class Kept(DefaultStrategy):
    mesh: open3d.geometry.TriangleMesh | None = None
import tensorly
tensorly.set_backend("pytorch")
try:
    open3d.io.read_point_cloud("points.ply")
except RuntimeError as error:
    print(error)
"""


def test_stand_ins_are_imported_and_their_use_is_an_error(load: Callable[[str], ModuleType], tmp_path: Path) -> None:
    environment = load("gpu_nerfstudio").stand_in(tmp_path)
    done = subprocess.run([sys.executable, "-c", USE], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "open3d.io.read_point_cloud is a stand-in: the package is not on this machine"


def test_commands_are_tabled_with_what_they_left(load: Callable[[str], ModuleType], tmp_path: Path) -> None:
    card = load("gpu_nerfstudio")
    environment, costs = card.stand_in(tmp_path / "stand-ins"), card.Rows(("command", "s", "host", "card"))
    assert card.run([sys.executable, "-c", "x = bytearray(200_000_000)"], tmp_path, environment, costs)
    assert not card.run([sys.executable, "-c", "raise SystemExit(3)"], tmp_path, environment, costs)
    assert float(costs.cells[0][2].replace(",", "")) > 200 and "| failed |  |" in str(costs)
    (tmp_path / "baked.json").write_text(json.dumps({"results": {"psnr": 28.149, "lpips": 0.08}}))
    assert "| baked | 28.15 |  | 0.080 |  |" in card.quality(tmp_path)


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
