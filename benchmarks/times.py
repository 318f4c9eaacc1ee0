#!/usr/bin/env python
"""Measure times: `times.py COMMAND OPTION...`; `times.py COMMAND --help` lists the options.

kernels      each CPU kernel
frames       frames of baked scenes on a GPU
cuda         CUDA kernels: each once, for sanitizers, or its time
peers        gsplat beside bundles of a capture on a GPU
nerfstudio   nerfstudio's commands on a capture, with a GPU or without
"""

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from importlib import import_module
from inspect import cleandoc
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch loads OpenMP

import torch
from harness import (
    Arguments,
    Options,
    Rows,
    device_milliseconds,
    image_size,
    number,
    publish,
    say,
    seconds,
    table,
)
from scenes import around, textured, trained_like, with_texels
from torch import Tensor
from torch.nn.functional import l1_loss

from bitymi_ns import ops
from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.baked import IMAGES
from bitymi_ns.ops.baked_cuda import Stage
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import HashField, TexelField

CPU = torch.device("cpu")
WARM_UP = 2
TILE_SIDE = 8
SIZES = ((1297, 840), (1920, 1080), (3840, 2160))
TIMED = ("list", "draw", "frame", "graph", "packed")
HEADER = ("scene", "size", "million pairs", "fragments/pixel", *(f"{name} ms" for name in TIMED), "frames/s")
Run = Callable[[], object]


def back(outputs: Tensor, inputs: Sequence[Tensor]) -> Run:
    """Prepare a backward pass on a retained graph, with fixed random gradients."""
    gradients = torch.randn_like(outputs)
    return lambda: torch.autograd.grad(outputs, inputs, gradients, retain_graph=True)


def cases(n: int, width: int, height: int) -> tuple[str, dict[str, Run]]:
    """Describe a scene's counts, and prepare its kernels by name; backward passes run on a retained graph."""
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
    side = torch.full((n, 2), TILE_SIDE, dtype=torch.int32)
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


def kernels(parser: Arguments, words: Sequence[str]) -> None:
    """Time each CPU kernel on a scene like a trained one (`scenes.trained_like`), through `bitymi_ns.ops` as in
    training and rendering: medians after two warm-up runs. The baked scene has a uint8 atlas, a tile per surfel, a
    texel per pixel."""
    parser.add_argument("--surfels", nargs="+", type=int, default=[5_000, 20_000], help="sizes of the scene")
    parser.add_argument("--size", type=image_size, default="270x480", metavar="WxH", help="(%(default)s)")
    parser.add_argument("--runs", type=int, default=9, help="timed runs a kernel (%(default)s)")
    parser.add_output()
    options = parser.parse_args(words)
    parts, load = [], os.getloadavg()[0]
    for n in options.surfels:
        counts, runs = cases(n, *options.size)
        rows = []
        for name, run in runs.items():
            wall, cpu = seconds(run, Options(CPU, WARM_UP, options.runs))
            say(f"{n:,} surfels, {name}: {1e3 * wall:.2f} ms")
            rows.append([name, number(1e3 * wall), number(1e3 * cpu)])
        title = f"### {n:,} surfels at {options.size[0]} x {options.size[1]}\n\n{counts}\n"
        parts.append(title + "\n" + table(("kernel", "ms", "CPU ms"), rows))
    notes = [
        f"Median of {options.runs} runs; {torch.get_num_threads()} threads. Load average at the start: {load:.1f}: "
        "other work on the machine spoils ms, CPU ms hardly."
    ]
    publish("CPU kernels", "\n\n".join(parts), notes, options.output)


def measured(scene: BakedScene, cameras: Sequence[Camera], options: Options) -> dict[str, float]:
    """Average over cameras of one size: pairs of surfel and tile, fragments, and the milliseconds of TIMED."""
    size, graph = (cameras[0].width, cameras[0].height), options.device.type == "cuda"
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
        for name, run in zip(TIMED, (*stages, recorded.run, packed.run), strict=True):
            sums[name] += device_milliseconds(run, options)
    return {key: value / len(cameras) for key, value in sums.items()}


def row(make: Callable[[], tuple[str, BakedScene, list[Camera]]], options: Options) -> list[str]:
    """Measure the cells of HEADER."""
    name, scene, cameras = make()
    width, height, mean = cameras[0].width, cameras[0].height, measured(scene, cameras, options)
    say(f"{name} surfels, {width} x {height}: {mean['graph']:.3f} ms")
    fragments = number(mean["fragments"] / (width * height), 1)
    times = [number(mean[key], 3) for key in TIMED]
    pairs = number(mean["pairs"] / 1e6)
    return [name, f"{width} x {height}", pairs, fragments, *times, number(1e3 / mean["graph"], 0)]


def frames(parser: Arguments, words: Sequence[str]) -> None:
    """Time frames of baked scenes on a GPU and print a table.

    Scenes: those of `scenes.textured`, and bundles (--bundles) with three cameras around their centre. "list" and
    "draw" are the two stages of a frame, "frame" is both launched by the host, "graph" the same as a CUDA graph,
    "packed" that with 8 bits per channel instead of floats. `--emulated` runs the kernels' host emulation on tiny
    scenes, to try the script without a GPU; its times are meaningless.
    """
    parser.add_argument("--surfels", nargs="*", type=int, default=[50_000, 150_000, 500_000], help="of the scenes")
    parser.add_argument("--sizes", nargs="+", type=image_size, default=SIZES, metavar="WxH", help="(%(default)s)")
    parser.add_argument("--bundles", nargs="+", type=Path, default=[], help="baked scenes to draw as well")
    parser.add_argument("--runs", type=int, default=200, help="timed frames, after ten untimed ones (%(default)s)")
    parser.add_argument("--emulated", action="store_true", help="try the script without a GPU")
    parser.add_output()
    arguments = parser.parse_args(words)
    surfels, sizes, options = [60], [(40, 24)], Options(CPU, 0, 1)
    notes = ["No GPU: kernels emulated on the host, times mean nothing."]
    if not arguments.emulated:
        surfels, sizes, options = arguments.surfels, arguments.sizes, Options(parser.device(), 10, arguments.runs)
        notes = [f"{torch.cuda.get_device_name(options.device)}, CUDA {torch.version.cuda}: medians, see `--help`."]

    def synthetic(n: int, width: int, height: int) -> tuple[str, BakedScene, list[Camera]]:
        scene, camera = textured(n, width, height, options.device)
        return f"synthetic, {n:,}", scene, [camera]

    def bundled(folder: Path, width: int, height: int) -> tuple[str, BakedScene, list[Camera]]:
        bundle = read_bundle(folder, decode=arguments.emulated)
        return f"{folder.name}, {len(bundle):,}", bundle.scene.to(options.device), around(bundle, width, height)

    rows = Rows(HEADER)
    with emulated_cuda() if arguments.emulated else nullcontext():
        for size in sizes:
            for make, each in [(synthetic, n) for n in surfels] + [(bundled, folder) for folder in arguments.bundles]:
                rows.add(f"{each}, {size[0]} x {size[1]}", partial(row, partial(make, each, *size), options))
    publish("Frames of baked scenes", str(rows), notes, arguments.output)


def baked(n: int, width: int, height: int, device: torch.device, every: bool = False) -> Run:
    """Prepare a frame with a BC7 atlas; `every`: with all images."""
    scene, camera = textured(n, width, height, device)
    if every:
        return lambda: scene.render_views([camera], None, tuple(IMAGES))
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


def exact(n: int, width: int, height: int, device: torch.device) -> Run:
    """Prepare a training step of either texture with deterministic sums."""
    steps = [training(n, width, height, device, tiled) for tiled in (False, True)]

    def run() -> None:
        torch.use_deterministic_algorithms(True, warn_only=True)  # some of torch's own operations have none
        for step in steps:
            step()
        torch.use_deterministic_algorithms(False)

    return run


SECTIONS = {"baked": baked, "images": partial(baked, every=True), "training": training}
SECTIONS |= {"texels": partial(training, tiled=True), "listed": partial(training, tiled=True, most=1 << 30)}
SECTIONS |= {"deterministic": exact}


def cuda(parser: Arguments, words: Sequence[str]) -> None:
    """Run each CUDA kernel once on a small scene, for sanitizers.

    `--sections baked training` selects kernels; `--times RUNS` prints the device time by kernel.
    """
    parser.add_argument("--surfels", type=int, default=300)
    parser.add_argument("--size", type=image_size, default="96x64", metavar="WxH", help="image size (%(default)s)")
    parser.add_argument("--sections", nargs="*", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--times", type=int, default=0, metavar="RUNS", help="time by kernel over so many runs")
    arguments = parser.parse_args(words)
    device = parser.device()
    for name in arguments.sections:
        run = SECTIONS[name](arguments.surfels, *arguments.size, device)
        if arguments.times:
            print_times(name, run, arguments.times)
        else:
            run()
            torch.cuda.synchronize()
            print(f"{name}: done", flush=True)


def print_times(name: str, run: Run, runs: int) -> None:
    """Print the device time per run of each kernel after a warm-up, longest first."""
    for _ in range(5):
        run()
    torch.cuda.synchronize()
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(runs):
            run()
        torch.cuda.synchronize()
    kernels = [e for e in profile.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    total = sum(e.self_device_time_total for e in kernels) / runs
    print(f"\n#### {name}: {total:.0f} us on the device per run, {sum(e.count for e in kernels) / runs:.0f} kernels\n")
    longest = sorted(kernels, key=lambda e: -e.self_device_time_total)[:45]
    rows = [(f"`{e.key[:90]}`", f"{e.count / runs:.1f}", f"{e.self_device_time_total / runs:.1f}") for e in longest]
    print(table(("kernel", "per run", "us per run"), rows))


COMMANDS = {"kernels": kernels, "frames": frames, "cuda": cuda}
MODULES = {"peers": "gpu_peers", "nerfstudio": "gpu_nerfstudio"}  # import much else


def main() -> int:
    """Run the command that the command line names."""
    command, *words = sys.argv[1:] or [""]
    if command not in (*COMMANDS, *MODULES):
        print(__doc__)
        return 0 if command in ("-h", "--help") else 2
    if command in MODULES:
        module = import_module(MODULES[command])
        run, text = module.main, module.__doc__
    else:
        run = COMMANDS[command]
        text = cleandoc(run.__doc__ or "")
    return run(Arguments(text, f"times.py {command}"), words) or 0


if __name__ == "__main__":
    sys.exit(main())
