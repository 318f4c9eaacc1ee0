"""Time frames of baked scenes on a GPU and print a table.

Scenes: those of `scenes.textured`, and bundles (--bundles) with three cameras around their centre. "list" and "draw"
are the two stages of a frame, "frame" is both launched by the host, "graph" the same as a CUDA graph, "packed" that
with 8 bits per channel instead of floats. `--emulated` runs the kernels' host emulation on tiny scenes, to try the
script without a GPU; its times are meaningless.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import torch
from harness import Arguments, Options, Rows, device_milliseconds, image_size, number, publish, say
from scenes import around, textured

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.baked_cuda import Stage
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera

SIZES = ((1297, 840), (1920, 1080), (3840, 2160))
TIMED = ("list", "draw", "frame", "graph", "packed")
HEADER = ("scene", "size", "million pairs", "fragments/pixel", *(f"{name} ms" for name in TIMED), "frames/s")


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


def main(parser: Arguments, words: Sequence[str]) -> None:
    """Time the scenes and publish the table."""
    parser.add_argument("--surfels", nargs="*", type=int, default=[50_000, 150_000, 500_000], help="of the scenes")
    parser.add_argument("--sizes", nargs="+", type=image_size, default=SIZES, metavar="WxH", help="(%(default)s)")
    parser.add_argument("--bundles", nargs="+", type=Path, default=[], help="baked scenes to draw as well")
    parser.add_argument("--runs", type=int, default=200, help="timed frames, after ten untimed ones (%(default)s)")
    parser.add_argument("--emulated", action="store_true", help="try the script without a GPU")
    parser.add_output()
    arguments = parser.parse_args(words)
    surfels, sizes, options = [60], [(40, 24)], Options(torch.device("cpu"), 0, 1)
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
