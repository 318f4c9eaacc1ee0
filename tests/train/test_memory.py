"""Near the end of memory surfels and texels stop growing, and the run goes on."""

import json
import subprocess
import sys
from types import SimpleNamespace

import psutil
import pytest
import torch

from bitymi_ns.train import memory, strategy
from bitymi_ns.train.memory import FILLED, room_to_grow
from bitymi_ns.train.processes import ALONE, Processes
from bitymi_ns.train.texels import SMALLEST
from tests.train.strategy_bench import Bench

CPU = torch.device("cpu")

RUN = """
import json, sys
from pathlib import Path
import psutil, torch
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train import memory
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.views import View

memory.FILLED = 0.9  # with less nothing would grow here, beside the program itself
memory.memory_limit = lambda: float(sys.argv[1])
torch.set_num_threads(1)
g = torch.Generator().manual_seed(0)
K = torch.tensor([[64.0, 0, 32], [0, 64, 24], [0, 0, 1]])
views = []
for i in range(4):
    viewmat = torch.eye(4)
    viewmat[0, 3], viewmat[2, 3] = 0.2 * i, 3.0
    views.append(View(Camera(viewmat, K, 64, 48), torch.rand(48, 64, 3, generator=g)))
points = 2 * torch.rand(8000, 3, generator=g) - 1
grows = DensifyConfig(interval=3000, start=0, min_interval=1, grad_threshold=0.0, abs_grad_threshold=0.0, importance=-1,
    growth=1e6, prune_budget=0.0, prune_error=0.0, reset_interval=30000, final_prune_steps=())
config = TrainConfig(densify=grows, num_downscales=0)
scene = scene_for_views(views, points, points.abs(), SceneConfig(texture="texels"), config, 40)
trainer = Trainer(scene, views, config, 40)
found = {}
while trainer.step < 40:
    trainer.advance()
    if trainer.step == 1:
        found["first"] = psutil.Process().memory_info().rss
lines = Path("/proc/self/status").read_text().splitlines()
found["peak"] = next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
found |= {"surfels": len(scene), "texels": len(scene.field.texels), "loss": trainer.loss}
print(json.dumps(found | trainer.training.by_memory))
"""


@pytest.mark.slow
def test_a_run_ends_below_a_limit_between_its_first_step_and_its_peak() -> None:
    def run(limit: float) -> tuple[dict[str, float], str]:
        done = subprocess.run([sys.executable, "-c", RUN, str(limit)], capture_output=True, text=True, check=True)
        return json.loads(done.stdout), done.stderr

    free, said = run(1e15)
    assert free["surfels"] > 60_000 and "surfels_by_memory" not in free and "stop growing" not in said
    limit = (free["first"] + free["peak"]) / 2
    bound, said = run(limit)
    assert bound["peak"] < limit < free["peak"]
    assert 5000 < bound["surfels"] == bound["surfels_by_memory"] < free["surfels"]
    assert f"Surfels stop growing at {bound['surfels_by_memory']:,}, as 75% of the memory is used up" in said


@pytest.mark.parametrize("taken", [None, "free", "group"])
def test_what_is_left_is_a_share_of_what_there_is(taken: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    used, available, limit = 2e9, 10e9, 1e15
    if taken == "free":
        available = 1e9
    elif taken == "group":
        limit = 3e9
    monkeypatch.setattr(psutil, "Process", lambda: SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=used)))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=available))
    monkeypatch.setattr(memory, "memory_limit", lambda: limit)
    assert room_to_grow(CPU, ALONE) == pytest.approx(FILLED * min(available + used, limit) - used)

    def reduce(self: Processes, tensors: list[torch.Tensor], how: object) -> None:
        for tensor in tensors:
            if float(tensor) > 0 and how == torch.distributed.ReduceOp.SUM:
                tensor += 1e9  # of the other process
            elif how == torch.distributed.ReduceOp.MAX:
                tensor.clamp_(min=-1e8)  # which has less room

    monkeypatch.setattr(Processes, "_reduce", reduce)
    there = min(available + 3e9, limit)
    assert room_to_grow(CPU, Processes(0, 2)) == pytest.approx(min(1e8, (FILLED * there - 3e9) / 2))


@pytest.mark.parametrize("max_surfels", [0, 60])
def test_densification_stops_where_memory_ends_and_stays_there(
    max_surfels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = [1e15]
    monkeypatch.setattr(strategy, "room_to_grow", lambda device, processes: room[0])
    b = Bench(monkeypatch, 40, prune_budget=0.0, max_surfels=max_surfels)
    each = memory.PER_SURFEL + SMALLEST**2 * memory.PER_TEXEL
    bounds = []
    for step, room[0] in ((1000, 1e15), (1500, 2.5 * each), (2000, 1e15)):
        bound = len(b.scene) + 2
        b.importance = torch.full((len(b.scene),), 9)
        b.see(1.0, 1.0)
        report = b.step(step)
        if "most_by_memory" in report:
            bounds.append((step, report["most_by_memory"]))
            assert bounds == [(1500, bound)]
    bound = bounds[0][1]
    assert len(b.scene) <= bound == b.strategy.most == b.strategy.most_by_memory
    state = b.strategy.state_dict()
    other = Bench(monkeypatch, 40, max_surfels=max_surfels).strategy
    before = other.most
    other.load_state_dict(state)
    assert other.most == bound
    other.load_state_dict({name: value for name, value in state.items() if name != "most_by_memory"})
    assert other.most == before
