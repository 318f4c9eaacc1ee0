"""Runs of two processes equal a run of one with the same views; and the loss of a process."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import surfels_from_points
from bitymi_ns.train.processes import ALONE, Processes, ProcessesApart
from tests.train import part_of_a_run
from tests.train.part_of_a_run import LOST, STEPS, train


@pytest.fixture
def inputs(cameras, ball, views) -> dict[str, Any]:
    """A quarter of the ball's points, and six views, one masked, one darker."""
    centers = torch.stack([camera.center for camera in cameras])
    surfels, _ = surfels_from_points(*(t[::4] for t in ball), centers, TrainConfig(), SceneConfig())
    mask = torch.zeros(48, 48, 1, dtype=torch.bool)
    mask[10:] = True
    changed = [*views[:4], views[4]._replace(mask=mask), views[5]._replace(image=0.7 * views[5].image)]
    return {"surfels": surfels, "views": changed, "texture": "texels", "exposure": "gain", "poses": "off"}


def start(folder: Path, inputs: dict[str, Any]) -> list[subprocess.Popen[str]]:
    torch.save(inputs, folder / "inputs.pt")
    root = Path(__file__).parents[2]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)}
    command = [sys.executable, part_of_a_run.__file__, str(folder)]
    return [
        subprocess.Popen([*command, rank, "2"], env=environment, stderr=subprocess.PIPE, text=True) for rank in "01"
    ]


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested states to tensors and numbers by name."""
    if isinstance(value, (dict, list, tuple)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {key: v for k, inner in items for key, v in flat(inner, f"{name}/{k}").items()}
    return {name: value}


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Use one thread, like the processes: torch's order of summation varies, and Adam's first steps follow signs."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    ("texture", "exposure", "poses"), [("texels", "gain", "off"), ("hash", "affine", "off"), ("texels", "off", "on")]
)
def test_two_processes_are_one_that_looks_at_as_many_views(tmp_path, inputs, texture, exposure, poses):
    inputs |= {"texture": texture, "exposure": exposure, "poses": poses}
    for process in start(tmp_path, inputs):
        assert process.wait(timeout=120) == 0, process.stderr.read()
    first, second = (torch.load(tmp_path / f"end-{rank}.pt", weights_only=True) for rank in range(2))
    assert first["digests"] == second["digests"] and len(first["digests"]) == STEPS // 10
    assert first["reports"] == second["reports"]
    own = ("/training/seconds", "/training/cpu_seconds")
    states = [{k: v for k, v in flat(result["state"]).items() if k not in own} for result in (first, second)]
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        same = torch.equal(value, states[1][name]) if isinstance(value, torch.Tensor) else value == states[1][name]
        assert same, name

    alone = train(inputs, Processes(each=2))
    did = [set().union(*(report.keys() for report in run["reports"])) for run in (first, alone)]
    assert did[0] == did[1] >= {"cloned", "split", "pruned", "opacity_reset"}
    assert [r.get("surfels") for r in first["reports"]] == [r.get("surfels") for r in alone["reports"]]
    expected = flat(alone["state"])
    assert ("/scene/field.texels" in expected) == (texture == "texels")
    if texture == "texels":
        assert expected["/scene/field.texels"].abs().mean() > 1e-3
    for name, value in states[0].items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-7, msg=lambda m, n=name: f"{n}: {m}")


SUMS = """
import os, sys, torch, torch.distributed as dist
from bitymi_ns.train.processes import Processes, ProcessLost, leave
rank = int(sys.argv[2])
dist.init_process_group("gloo", init_method=f"file://{sys.argv[1]}/meeting", rank=rank, world_size=2)
processes = Processes.joined()
processes.sum(torch.ones(3))
if rank == 1:
    os._exit(1)
try:
    processes.sum(*(torch.ones(100) for _ in range(400)))
except ProcessLost:
    leave(3)
"""


@pytest.mark.slow
def test_sums_that_are_lost_do_not_abort_the_process_as_it_ends(tmp_path):
    """Threads of gloo that wait for a lost process abort an interpreter that shuts down."""
    command = [sys.executable, "-c", SUMS, str(tmp_path)]
    first, second = (subprocess.Popen([*command, rank], stderr=subprocess.PIPE, text=True) for rank in "01")
    assert second.wait(timeout=60) == 1
    assert first.wait(timeout=60) == LOST, first.stderr.read()


def test_views_are_dealt_out_in_the_order_of_training():
    dealt = [[*Processes(rank, 3, 2).view_numbers(step)] for step in range(2) for rank in range(3)]
    assert [number for numbers in dealt for number in numbers] == list(range(12))
    assert [*ALONE.view_numbers(7)] == [7] and ALONE == Processes.joined()


def test_one_process_alone_asks_nobody():
    value, parameter = torch.rand(3), torch.nn.Parameter(torch.rand(3))
    parameter.grad = value.clone()
    ALONE.sum(parameter.grad)
    ALONE.average_gradients([parameter, torch.nn.Parameter(value)], 5)
    assert torch.equal(parameter.grad, value)
    assert ALONE.first_error(None) is None and ALONE.first_error("it broke") == "it broke"
    assert ALONE.from_first("anything", "cpu") == "anything" and ALONE.mean(0.1) == 0.1
    two = Processes(each=2)
    two.average_gradients([parameter], 5)
    assert torch.equal(parameter.grad, value / 2) and two.views == 2


def test_processes_that_have_come_apart_do_not_add_their_gradients(monkeypatch):
    monkeypatch.setattr(Processes, "_largest", lambda self, values: [1, 7, -6])  # another process has 6 surfels
    with pytest.raises(ProcessesApart, match="one has 7 surfels, another 6"):
        Processes(0, 2).average_gradients([torch.nn.Parameter(torch.rand(3))], 7)
