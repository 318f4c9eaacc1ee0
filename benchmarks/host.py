"""Measure the host's share of a CUDA training step without a GPU: time, kernel launches, torch operations and waits.

The emulated kernels return at once, so the time is that of Python, torch and the bindings; a GPU's launches and
allocator add to it. Waits are operations of torch that read from the device. Losses are checked in every step here,
every few on a GPU, because the emulated device is the CPU.
"""

import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType

import torch
from harness import Arguments, number, publish, table
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bitymi_ns.ops.backend import emulated_cuda, load
from bitymi_ns.scene import Camera, SceneConfig
from bitymi_ns.train.config import DensifyConfig, TexelConfig, TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.views import View

STEPS, TEXELS, MEASURED, COUNTED = 30_000, 600, 400, 20  # steps of the run, before texels, timed and counted
HEADER = ("stage", "ms of CPU time, median", "least", "kernels", "other operations", "views, detached", "waits")
READS = ("local_scalar_dense", "nonzero")
VIEWED = ("detach", "view", "select", "slice", "unbind", "alias", "expand", "as_strided", "squeeze")  # launch nothing


class Counted(TorchDispatchMode):
    """Counter of torch's operations by name."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))

    def per_step(self, names: tuple[str, ...]) -> float:
        return sum(name.lstrip("_").startswith(names) for name in self.names) / COUNTED


@contextmanager
def idle(emulator: ModuleType) -> Iterator[None]:
    """Make kernels return at once; clear new memory, so that counts that no kernel wrote are 0."""
    replaced = [(torch, "empty", torch.zeros), (torch, "empty_like", torch.zeros_like)]
    replaced.append((Tensor, "new_empty", Tensor.new_zeros))
    kept = [(where, name, getattr(where, name)) for where, name, _ in replaced]
    emulator.set_idle(True)
    try:
        for where, name, value in replaced:
            setattr(where, name, value)
        yield
    finally:
        emulator.set_idle(False)
        for where, name, value in kept:
            setattr(where, name, value)


def row(run: Trainer, emulator: ModuleType, stage: str) -> list[str]:
    """Measure steps of a run and return a row of the table."""
    launched = emulator.launches()
    with Counted() as counted:
        for _ in range(COUNTED):
            run.advance()
    kernels = (emulator.launches() - launched) / COUNTED
    times = []
    for _ in range(MEASURED):
        started = time.thread_time()
        run.advance()
        times.append(1e3 * (time.thread_time() - started))
    viewed, waits = counted.per_step(VIEWED), counted.per_step(READS)
    other = len(counted.names) / COUNTED - viewed - waits
    least = [number(statistics.median(times)), number(min(times))]
    return [stage, *least, *(number(figure, 0) for figure in (kernels, other, viewed, waits))]


def trainer(exposure: str) -> Trainer:
    """Make a run of 40 surfels on random photographs, with texels from step TEXELS on."""
    g = torch.Generator().manual_seed(0)
    points, colors = torch.rand(40, 3, generator=g) - 0.5, torch.rand(40, 3, generator=g)
    viewmat, K = torch.eye(4), torch.tensor([[24.0, 0, 12], [0, 24, 12], [0, 0, 1]])
    viewmat[2, 3] = 2.0
    views = [View(Camera(viewmat, K, 24, 24), torch.rand(24, 24, 3, generator=g)) for _ in range(8)]
    still = DensifyConfig(min_interval=STEPS, min_surfels=40, max_surfels=40)
    config = TrainConfig(exposure=exposure, resolution_schedule=0, densify=still, texels=TexelConfig(start=TEXELS))
    scene = scene_for_views(views, points, colors, SceneConfig(texture="texels"), config, STEPS)
    return Trainer(scene, views, config, STEPS)


def main(parser: Arguments, words: Sequence[str]) -> None:
    parser.add_argument("--exposure", default="off", choices=("off", "gain", "affine"))
    parser.add_output()
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    emulator = load("_emulated")
    with emulated_cuda():
        run, rows = trainer(arguments.exposure), []
        for stage, first in (("surfels", 0), ("texels", TEXELS)):
            run.step = first
            for _ in range(2):  # creates optimisers' states and tiles
                run.advance()
            with idle(emulator):
                rows.append(row(run, emulator, stage))
    publish("The host's share of a step", table(HEADER, rows), (), arguments.output)
