#!/usr/bin/env python
"""Time baked frames and training steps on a card (median after a warm-up) and print tables.

Needs the core packages alone (torch, numpy). `--emulated` runs the host's emulation of the kernels on tiny scenes, to
try the script without a card; its times mean nothing.
"""

import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import gpu_baked
import torch
from common import arguments_of, number, page, publish, say, table
from harness import (
    Options,
    attempt,
    copy_bandwidth,
    failures,
    milliseconds,
    peak_memory,
    photo_loss,
    trained_like,
    training_step,
    with_texels,
)
from torch import Tensor

from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.scene import Scene


def steps(options: Options) -> str:
    """Whole training steps: rendering, 0.8 L1 + 0.2 (1 - SSIM), backward, Adam."""
    parts = []
    for width, height in options.sizes:
        photo = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1)).to(options.device)
        for n in options.surfels:
            rows, where = [], f"{n:,} surfels, {width} x {height}"
            for name, run, pairs in attempt(where, partial(_steps, n, width, height, photo, options)) or ():
                ms = attempt(f"{where}, {name}", partial(milliseconds, run, options))
                if ms is None:
                    continue
                say(f"{where}, step of {name}: {ms:.3f} ms")
                memory = peak_memory(run, options.device) / 1e6
                rows.append([name, number(ms, 3), number(pairs, 0), number(memory, 0)])
            header = ("step", "ms", "pairs of surfel and tile", "peak MB")
            parts.append(f"#### {n:,} surfels at {width} x {height}\n\n" + table(header, rows))
    return "### Training steps\n\n" + "\n\n".join(parts) + failures()


def _steps(
    n: int, width: int, height: int, photo: Tensor, options: Options
) -> list[tuple[str, Callable[[], object], int]]:
    device, loss = options.device, photo_loss(photo)
    cases: list[tuple[str, Callable[[], object], int]] = []
    for name, mode in (
        ("bitymi, field training", "train"),
        ("bitymi, field frozen", "frozen"),
        ("bitymi, sv", "off"),
        ("bitymi, texels training", "train"),
    ):
        if "texels" in name:
            scene, camera = with_texels(n, width, height, device)
        else:
            scene, camera = trained_like(n, width, height, device, texture=mode != "off")
        # texels have no optimiser: the backward pass moves them
        whole = mode == "train" and "texels" not in name
        parameters = list(scene.parameters() if whole else scene.surfels.parameters())

        def render(scene: Scene = scene, camera: Camera = camera, mode: str = mode) -> Tensor:
            return scene.render(camera, field_mode=mode).rgb

        pairs = scene.render(camera, field_mode="off").fragments.layout.handle.pairs
        cases.append((name, training_step(render, loss, parameters), pairs))
    return cases


SECTIONS = {"baked": gpu_baked.frames, "steps": steps}


def card(device: torch.device) -> list[str]:
    """The card, its clocks and its driver."""
    if device.type != "cuda":
        return ["No card: kernels emulated on the host, times mean nothing."]
    properties = torch.cuda.get_device_properties(device)
    query = ["nvidia-smi", "--query-gpu=driver_version,clocks.sm,clocks.mem,clocks.max.sm,power.limit,temperature.gpu"]
    try:
        asked = subprocess.run([*query, "--format=csv,noheader"], capture_output=True, text=True, check=False).stdout
    except OSError:
        asked = ""
    return [
        f"{properties.name}, {properties.multi_processor_count} multiprocessors, "
        f"{properties.total_memory / 2**30:.0f} GiB, compute capability {properties.major}.{properties.minor}; "
        f"torch {torch.__version__}, CUDA {torch.version.cuda}.",
        f"Driver, clocks now (SM, memory), highest, power limit, temperature: {asked.strip() or 'not known'}.",
    ]


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("--surfels", nargs="+", type=int, default=[50_000, 150_000, 500_000], help="of the scenes")
    parser.add_argument("--sizes", nargs="+", default=["1297x840", "1920x1080"], metavar="WxH", help="(%(default)s)")
    parser.add_argument("--bundles", nargs="+", type=Path, default=[], help="baked scenes to draw as well")
    parser.add_argument("--warm-up", type=int, default=10)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--sections", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--emulated", action="store_true", help="try the script without a card")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file, anew as each section ends")
    arguments = parser.parse_args()
    if not (arguments.emulated or torch.cuda.is_available()):
        parser.error("no CUDA device was found (or torch is a CPU build); --emulated tries the script without")
    device = torch.device("cpu" if arguments.emulated else "cuda")
    surfels, sizes = arguments.surfels, [tuple(int(part) for part in size.split("x")) for size in arguments.sizes]
    warm_up, runs = arguments.warm_up, arguments.runs
    if arguments.emulated:
        surfels, sizes, warm_up, runs = [60], [(40, 24)], 0, 1
    parts: list[str] = []
    with emulated_cuda() if arguments.emulated else nullcontext():
        bandwidth = copy_bandwidth(device)
        notes = [
            *card(device),
            f"Copy within the device: {number(bandwidth / 1e9, 0)} GB/s, read and written bytes counted.",
            f"Times: medians of about {runs} calls after {warm_up}, queued so that the host does not hold the device "
            "up, unless a column says otherwise.",
        ]
        options = Options(device, warm_up, runs, surfels, sizes, bandwidth, arguments.bundles)
        for name in arguments.sections:
            parts.append(SECTIONS[name](options))
            publish(page("CUDA kernels", "\n\n".join(parts), notes), arguments.output, name != arguments.sections[-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
