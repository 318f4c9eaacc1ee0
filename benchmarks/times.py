#!/usr/bin/env python
"""Measure times: `times.py COMMAND --help` lists the options."""

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Literal

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch loads OpenMP

import torch
import tyro
from scenes import around, textured, trained_like, with_texels
from torch.nn.functional import l1_loss

from bitymi_ns import ops
from bitymi_ns.bundle import read_bundle
from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.markdown import number, page, publish, table
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.baked_renderer import BakedRenderer, Stage
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField

CPU = torch.device("cpu")
CLOCK = 2.0e9  # upper bound of GPU clocks, Hz, to convert seconds to cycles of `torch.cuda._sleep`
TIMED = ("list", "draw", "frame", "graph", "packed")
HEADER = ("scene", "size", "million pairs", "fragments/pixel", *(f"{name} ms" for name in TIMED), "frames/s")
Run = Callable[[], object]


def gpu() -> torch.device:
    """Return the first GPU; end the script without one."""
    if not torch.cuda.is_available():
        raise SystemExit("no CUDA device was found (or torch is a CPU build)")
    return torch.device("cuda")


def device_milliseconds(run: Run, runs: int) -> float:
    """Measure the median time of a call on the GPU, after ten untimed ones. Calls are queued behind a spin of the
    device that outlasts the queueing, so that launches are not measured; synchronisations within a call
    are."""
    for _ in range(10):
        run()
    torch.cuda.synchronize()
    start = time.perf_counter()
    run()
    host = time.perf_counter() - start
    torch.cuda.synchronize()
    calls = max(1, min(16, runs, round(2e-3 / max(host, 1e-6))))
    spin = int(min(0.02, 2.0 * calls * host + 1e-4) * CLOCK)
    times = []
    for _ in range(max(5, math.ceil(runs / calls))):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda._sleep(spin)
        begin.record()
        for _ in range(calls):
            run()
        end.record()
        torch.cuda.synchronize()
        times.append(begin.elapsed_time(end) / calls)
    return statistics.median(times)


def frame_row(
    name: str, scene: BakedScene, cameras: Sequence[Camera], milliseconds: Callable[[Run], float]
) -> list[str]:
    """Measure the cells of HEADER, means over cameras of one size."""
    width, height = size = (cameras[0].width, cameras[0].height)
    graph = scene.tiles.is_cuda
    sums = dict.fromkeys(("pairs", "fragments", *TIMED), 0.0)
    for camera in cameras:
        sums["fragments"] += float(scene.render_views([camera], None, ("overdraw",))["overdraw"].sum())
        frame = BakedRenderer(scene, *size)
        recorded = BakedRenderer(scene, *size, graph=graph)
        packed = BakedRenderer(scene, *size, images=("packed",), graph=graph)
        for renderer in (frame, recorded, packed):
            renderer.draw([camera])
        sums["pairs"] += frame.workspace.pairs
        stages = (partial(frame.run, Stage.LIST), partial(frame.run, Stage.DRAW), frame.run)
        for stage, run in zip(TIMED, (*stages, recorded.run, packed.run), strict=True):
            sums[stage] += milliseconds(run)
    mean = {key: value / len(cameras) for key, value in sums.items()}
    say(f"{name} surfels, {width} x {height}: {mean['graph']:.3f} ms")
    fragments = number(mean["fragments"] / (width * height), 1)
    times = [number(mean[key], 3) for key in TIMED]
    pairs = number(mean["pairs"] / 1e6)
    return [name, f"{width} x {height}", pairs, fragments, *times, number(1e3 / mean["graph"], 0)]


def frames(
    surfels: tuple[int, ...] = (50_000, 150_000, 500_000),
    sizes: tuple[tuple[int, int], ...] = ((1297, 840), (1920, 1080), (3840, 2160)),
    bundles: tuple[Path, ...] = (),
    runs: int = 200,
    emulated: bool = False,
    output: Path | None = None,
) -> None:
    """Time frames of baked scenes on a GPU. "list" and "draw" are the two stages of a frame, "frame" is both launched
    by the host, "graph" the same as a CUDA graph, "packed" that with 8 bits per channel instead of floats.

    Args:
        surfels: Sizes of the synthetic scenes (`scenes.textured`).
        sizes: Widths and heights of the images.
        bundles: Bundles to draw as well, from three sides.
        runs: Timed frames, after ten untimed ones.
        emulated: Try the script without a GPU, by host emulation.
        output: Also write the Markdown to this file.
    """
    if emulated:
        surfels, sizes, device = (60,), ((40, 24),), CPU
        notes = ["No GPU: kernels emulated on the host, times mean nothing."]
    else:
        device = gpu()
        notes = [f"{torch.cuda.get_device_name(device)}, CUDA {torch.version.cuda}: medians, see `--help`."]

    def milliseconds(run: Run) -> float:
        return 1e3 * timeit(run, number=1) if emulated else device_milliseconds(run, runs)

    def make(source: int | Path, width: int, height: int) -> tuple[str, BakedScene, list[Camera]]:
        if isinstance(source, int):
            scene, camera = textured(source, width, height, device)
            return f"synthetic, {source:,}", scene, [camera]
        bundle = read_bundle(source, decode=emulated)
        return f"{source.name}, {len(bundle):,}", bundle.scene.to(device), around(bundle, width, height)

    rows = []
    with emulated_cuda() if emulated else nullcontext():
        for size in sizes:
            for source in (*surfels, *bundles):
                try:
                    rows.append(frame_row(*make(source, *size), milliseconds))
                except (RuntimeError, ValueError, OSError) as error:
                    notes.append(f"Failed: {source}, {size[0]} x {size[1]}: {' '.join(str(error).split())[:400]}")
                    say(notes[-1])
    publish(page("Frames of baked scenes", table(HEADER, rows), notes), output)


def baked(n: int, width: int, height: int, device: torch.device) -> Run:
    """Prepare a frame of a baked scene."""
    scene, camera = textured(n, width, height, device)
    if device.type == "cpu":
        return torch.profiler.record_function("BakedScene.render")(partial(scene.render, camera))
    renderer = BakedRenderer(scene, width, height)
    renderer.draw([camera])
    return renderer.run


def training(n: int, width: int, height: int, device: torch.device, tiled: bool = False, most: int = 0) -> Run:
    """Prepare a training step with the field, or with texels if `tiled`. `most`: limit of a fragment list, 0 = none."""
    scene, camera = (with_texels if tiled else trained_like)(n, width, height, device)
    scene.config.max_fragments = most
    # rates 0: the work of a step without changing the scene
    descent = ops.TexelDescent(scene.field.share, 0.0) if isinstance(scene.field, TexelField) else None
    optimizer = torch.optim.Adam((scene.surfels if tiled else scene).parameters(), lr=0.0, fused=True)
    photo = torch.rand(height, width, 3, device=device)

    def run() -> None:
        optimizer.zero_grad(set_to_none=True)
        rgb = scene.render(camera, descent=descent).rgb
        (0.8 * l1_loss(rgb, photo) + 0.2 * (1 - ops.ssim(rgb, photo))).backward()
        optimizer.step()

    return run


Section = Literal["baked", "training", "texels", "listed"]
SECTIONS: dict[Section, Callable[[int, int, int, torch.device], Run]] = {
    "baked": baked,
    "training": training,
    "texels": partial(training, tiled=True),
    "listed": partial(training, tiled=True, most=1 << 30),
}


def kernels(
    device: Literal["cpu", "cuda"] = "cpu",
    surfels: int = 5_000,
    size: tuple[int, int] = (270, 480),
    sections: tuple[Section, ...] = tuple(SECTIONS),
    times: int = 9,
) -> None:
    """Print the time by kernel of frames and training steps, on a scene like a trained one (`scenes.trained_like`).

    Args:
        device: cpu or cuda.
        surfels: Size of the scene.
        size: Width and height of the image.
        sections: What to run; all by default.
        times: Timed runs, after five untimed ones; 0 = run once, for sanitizers.
    """
    place = gpu() if device == "cuda" else CPU

    def repeat(run: Run, count: int) -> None:
        for _ in range(count):
            run()
        if device == "cuda":
            torch.cuda.synchronize()

    for name in sections:
        run = SECTIONS[name](surfels, *size, place)
        repeat(run, 5 if times else 1)
        print(f"{name}: done", flush=True)
        if times:
            with torch.profiler.profile() as profile:
                repeat(run, times)
            print(f"\n{name}, {times} runs:")
            by = f"self_{'device' if device == 'cuda' else 'cpu'}_time_total"
            print(profile.key_averages().table(by, row_limit=45, max_name_column_width=90))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"kernels": kernels, "frames": frames}, description=__doc__)
