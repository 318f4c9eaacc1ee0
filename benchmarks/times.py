#!/usr/bin/env python
"""Measure times: `times.py COMMAND --help` lists the options."""

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch loads OpenMP

import torch
import tyro
from scenes import around, textured, trained_like, with_texels
from torch import Tensor
from torch.nn.functional import l1_loss

from bitymi_ns import ops
from bitymi_ns.bundle import read_bundle
from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.markdown import number, page, publish, table
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.baked_renderer import BakedRenderer, Stage
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import HashField, TexelField

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


def seconds(run: Run, runs: int, warm_up: int = 2) -> tuple[float, float]:
    """Measure the median wall-clock and CPU seconds of a call on the CPU, after `warm_up` untimed calls."""
    times = []
    for _ in range(warm_up + runs):
        wall, cpu = time.perf_counter(), time.process_time()
        run()
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = map(statistics.median, zip(*times[warm_up:], strict=True))
    return wall, cpu


def device_milliseconds(run: Run, runs: int) -> float:
    """Measure the median time of a call on the GPU, after ten untimed ones. Calls are queued behind a spin of the
    device that outlasts the queueing, so that launches are not measured."""
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


def back(outputs: Tensor, inputs: Sequence[Tensor]) -> Run:
    """Prepare a backward pass on a retained graph, with fixed random gradients."""
    gradients = torch.randn_like(outputs)
    return lambda: torch.autograd.grad(outputs, inputs, gradients, retain_graph=True)


def cases(n: int, width: int, height: int) -> tuple[str, dict[str, Run]]:
    """Describe a scene's counts, and prepare its kernels by name."""
    scene, camera = trained_like(n, width, height, CPU)
    baked, _ = textured(n, width, height, CPU)
    q, field, bound = scene.surfels, scene.field, scene.config.weight_bound
    assert isinstance(field, HashField)
    geometry = geometry_of(q)
    project = partial(ops.project, *geometry, camera, scene.near)
    projection = project()
    fragments = ops.trace(projection, scene.config.rim)
    base = scene.base_color(projection)
    leaf = base.detach().requires_grad_()  # leaves, so that each backward pass runs one kernel
    residual = partial(ops.fragment_residual, fragments, projection.frames.detach(), field.geometry)
    fixed = tuple(w.detach() for w in field.weights)
    listed = residual(fixed, bound).requires_grad_()
    geom = projection.geom.detach().requires_grad_()
    weight, uv = (values.detach().requires_grad_() for values in (fragments.weight, fragments.uv))
    alone = replace(fragments, weight=weight, uv=uv, depth=fragments.depth.detach())
    blend = partial(ops.blended_image, alone, replace(projection, geom=geom), leaf, bound=bound)
    side = torch.full((n, 2), 8, dtype=torch.int32)
    tiles = ops.TexelTiles.of_sizes(side, projection.geom.new_full((n,), SUPPORT))
    texels = (torch.rand(tiles.count, 3) - 0.5).requires_grad_()
    photo, other = (torch.rand(height, width, 3) for _ in range(2))
    other.requires_grad_()
    view = tuple(q[name] for name in ops.VIEW_COLORS["sv"].names)
    textured_share = float((fragments.weight >= bound).float().mean())
    counts = (
        f"{int(projection.visible.sum()):,} visible, {len(fragments):,} fragments "
        f"({len(fragments) / (width * height):.1f} per pixel), {100 * textured_share:.0f} % of them textured"
    )
    forward = {
        "project": project,
        "view colour": partial(scene.base_color, projection),
        "trace": partial(ops.trace, projection, scene.config.rim),
        "field": partial(residual, fixed, bound),
        "blend": blend,
        "blend, field": partial(blend, residual=listed),
        "blend, texels": partial(blend, texels, tiles),
        "baked render, uint8 atlas": partial(baked.render, camera),
    }
    backward = {
        "project backward": back(projection.geom, geometry),
        "view colour backward": back(base, (q["means"], *view)),
        "trace backward": back(fragments.weight, (projection.geom,)),
        "field backward": back(residual(field.weights, bound), field.weights),
        "blend backward": back(blend(), (weight, geom, leaf)),
        "blend backward, field": back(blend(residual=listed), (weight, geom, leaf, listed)),
        "blend backward, texels": back(blend(texels, tiles), (weight, uv, geom, leaf, texels)),
        "ssim forward + backward": lambda: torch.autograd.grad(ops.ssim(other, photo), other),
    }
    return counts, {name: torch.no_grad()(run) for name, run in forward.items()} | backward


def kernels(
    surfels: tuple[int, ...] = (5_000, 20_000),
    size: tuple[int, int] = (270, 480),
    runs: int = 9,
    output: Path | None = None,
) -> None:
    """Time each CPU kernel on a scene like a trained one (`scenes.trained_like`): medians after two warm-up runs. The
    baked scene has a tile per surfel and a texel per pixel.

    Args:
        surfels: Sizes of the scene.
        size: Width and height of the image.
        runs: Timed runs of a kernel.
        output: Also write the Markdown to this file.
    """
    parts, load = [], os.getloadavg()[0]
    for n in surfels:
        counts, prepared = cases(n, *size)
        rows = []
        for name, run in prepared.items():
            wall, cpu = seconds(run, runs)
            say(f"{n:,} surfels, {name}: {1e3 * wall:.2f} ms")
            rows.append([name, number(1e3 * wall), number(1e3 * cpu)])
        parts += [f"### {n:,} surfels at {size[0]} x {size[1]}", counts, table(("kernel", "ms", "CPU ms"), rows)]
    note = f"Median of {runs} runs; {torch.get_num_threads()} threads. Load average at the start: {load:.1f}."
    publish(page("CPU kernels", "\n\n".join(parts), [note]), output)


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
        bundles: Bundles to draw as well, from three cameras around their centre.
        runs: Timed frames, after ten untimed ones.
        emulated: Try the script without a GPU, by the kernels' host emulation, whose times mean nothing.
        output: Also write the Markdown to this file.
    """
    if emulated:
        surfels, sizes, device = (60,), ((40, 24),), CPU
        notes = ["No GPU: kernels emulated on the host, times mean nothing."]
    else:
        device = gpu()
        notes = [f"{torch.cuda.get_device_name(device)}, CUDA {torch.version.cuda}: medians, see `--help`."]

    def milliseconds(run: Run) -> float:
        return 1e3 * seconds(run, 1, 0)[0] if emulated else device_milliseconds(run, runs)

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
    renderer = BakedRenderer(scene, width, height)
    renderer.draw([camera])
    return renderer.run


def training(n: int, width: int, height: int, device: torch.device, tiled: bool = False, most: int = 0) -> Run:
    """Prepare a training step: render, loss 0.8 L1 + 0.2 (1 - SSIM), backward and Adam, with the field, or with texels
    if `tiled`. `most`: limit of a fragment list, 0 = none."""
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


def cuda(
    surfels: int = 300,
    size: tuple[int, int] = (96, 64),
    sections: tuple[Section, ...] = tuple(SECTIONS),
    times: int = 0,
) -> None:
    """Run the CUDA kernels of the sections once on a small scene, for sanitizers, or print their device times.

    Args:
        surfels: Size of the scene.
        size: Width and height of the image.
        sections: Kernels to run.
        times: Time by kernel over so many runs.
    """
    device = gpu()
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    for name in sections:
        run = SECTIONS[name](surfels, *size, device)
        for _ in range(5 if times else 1):
            run()
        torch.cuda.synchronize()
        print(f"{name}: done", flush=True)
        if times:
            with torch.profiler.profile(activities=activities) as profile:
                for _ in range(times):
                    run()
                torch.cuda.synchronize()
            print(f"\n{name}, {times} runs:")
            print(profile.key_averages().table("self_device_time_total", row_limit=45, max_name_column_width=90))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"kernels": kernels, "frames": frames, "cuda": cuda}, description=__doc__)
