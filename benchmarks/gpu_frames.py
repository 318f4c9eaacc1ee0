"""Time frames of baked scenes on a GPU (medians after a warm-up) and print a table.

Scenes: those of `scenes.textured`, and bundles (--bundles) with three cameras around their centre. "list" and "draw"
are the two stages of a frame, "frame" is both launched by the host, "graph" the same as a CUDA graph, "packed" that
with 8 bits per channel instead of floats, "waited for" includes synchronising after each frame. "ends at 1/512" is the
packed graph with pixels that end at that transmittance instead of 1e-4.

Needs only the core packages (torch, numpy). `--emulated` runs the kernels' host emulation on tiny scenes, to try the
script without a GPU; its times are meaningless.
"""

import subprocess
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from harness import Arguments, Options, Rows, device_milliseconds, image_size, number, publish, say, seconds
from scenes import around, textured

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.baked_cuda import Stage
from bitymi_ns.scene.baked import FAST, BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera

SIZES = ((1297, 840), (1920, 1080), (3840, 2160))
TIMED = ("list", "draw", "frame", "graph", "packed", "waited for", "early")
"""Timings of `measured`, in the order of the columns from "list ms" on."""
HEADER = (
    "scene", "size", "million pairs", "fragments/pixel", "list ms", "draw ms", "frame ms", "graph ms",
    "packed, graph ms", "packed, waited for ms", "ends at 1/512, graph ms", "frames/s", "G fragments/s",
)  # fmt: skip


def measured(scene: BakedScene, cameras: Sequence[Camera], options: Options) -> dict[str, float]:
    """Average over cameras of one size: pairs of surfel and tile, fragments, and the milliseconds of TIMED."""
    size, graph = (cameras[0].width, cameras[0].height), options.device.type == "cuda"
    sums = dict.fromkeys(("pairs", "fragments", *TIMED), 0.0)
    for camera in cameras:
        sums["fragments"] += float(scene.render_views([camera], None, ("overdraw",))["overdraw"].sum())
        frame = BakedRenderer(scene, *size)
        recorded = BakedRenderer(scene, *size, graph=graph)
        packed = BakedRenderer(scene, *size, images=("packed",), graph=graph)
        early = BakedRenderer(replace(scene, transmittance_min=FAST), *size, images=("packed",), graph=graph)
        for renderer in (frame, recorded, packed, early):
            renderer.draw([camera])
        sums["pairs"] += frame.workspace.pairs
        cases: dict[str, Callable[[], object]] = {
            "list": partial(frame.run, Stage.LIST), "draw": partial(frame.run, Stage.DRAW), "frame": frame.run,
            "graph": recorded.run, "packed": packed.run, "early": early.run,
        }  # fmt: skip
        for name, run in cases.items():
            sums[name] += device_milliseconds(run, options)
        sums["waited for"] += 1e3 * seconds(packed.run, options)[0]
    return {key: value / len(cameras) for key, value in sums.items()}


def synthetic(n: int, width: int, height: int, options: Options) -> list[str]:
    """Measure the row of a synthetic scene of n surfels."""
    scene, camera = textured(n, width, height, options.device)
    return row(f"synthetic, {n:,}", scene, [camera], options)


def bundled(folder: Path, width: int, height: int, options: Options) -> list[str]:
    """Measure the row of a bundle."""
    bundle = read_bundle(folder, decode=options.device.type != "cuda")
    scene = bundle.scene.to(options.device)
    return row(f"{folder.name}, {len(bundle):,}", scene, around(bundle, width, height), options)


def row(name: str, scene: BakedScene, cameras: Sequence[Camera], options: Options) -> list[str]:
    """Measure the cells of HEADER."""
    width, height, mean = cameras[0].width, cameras[0].height, measured(scene, cameras, options)
    say(f"{name} surfels, {width} x {height}: {mean['graph']:.3f} ms")
    return [
        name,
        f"{width} x {height}",
        number(mean["pairs"] / 1e6, 2),
        number(mean["fragments"] / (width * height), 1),
        *(number(mean[key], 3) for key in TIMED),
        number(1e3 / mean["graph"], 0),
        number(mean["fragments"] / mean["draw"] / 1e6, 1),
    ]


def card(device: torch.device) -> list[str]:
    """Describe the GPU, its clocks and its driver."""
    if device.type != "cuda":
        return ["No card: kernels emulated on the host, times mean nothing."]
    properties = torch.cuda.get_device_properties(device)
    query = ["nvidia-smi", "--query-gpu=driver_version,clocks.sm,clocks.mem,clocks.max.sm,power.limit,temperature.gpu"]
    try:
        status = subprocess.run([*query, "--format=csv,noheader"], capture_output=True, text=True, check=False).stdout
    except OSError:
        status = ""
    return [
        f"{properties.name}, {properties.multi_processor_count} multiprocessors, "
        f"{properties.total_memory / 2**30:.0f} GiB, compute capability {properties.major}.{properties.minor}; "
        f"torch {torch.__version__}, CUDA {torch.version.cuda}.",
        f"Driver, clocks now (SM, memory), highest, power limit, temperature: {status.strip() or 'not known'}.",
    ]


def main(parser: Arguments, words: Sequence[str]) -> None:
    """Time the scenes and publish the table."""
    parser.add_argument("--surfels", nargs="*", type=int, default=[50_000, 150_000, 500_000], help="of the scenes")
    parser.add_argument("--sizes", nargs="+", type=image_size, default=SIZES, metavar="WxH", help="(%(default)s)")
    parser.add_argument("--bundles", nargs="+", type=Path, default=[], help="baked scenes to draw as well")
    parser.add_argument("--warm-up", type=int, default=10)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--emulated", action="store_true", help="try the script without a card")
    parser.add_output()
    arguments = parser.parse_args(words)
    if arguments.emulated:
        surfels, sizes, options = [60], [(40, 24)], Options(torch.device("cpu"), 0, 1)
    else:
        surfels, sizes = arguments.surfels, arguments.sizes
        options = Options(parser.device(), arguments.warm_up, arguments.runs)
    notes = [
        *card(options.device),
        f"Times: medians of about {options.runs} calls after {options.warm_up}, queued so that the host does not hold "
        "the device up, unless a column says otherwise.",
    ]
    rows = Rows(HEADER)
    with emulated_cuda() if arguments.emulated else nullcontext():
        for width, height in sizes:
            for make, each in [(synthetic, n) for n in surfels] + [(bundled, folder) for folder in arguments.bundles]:
                rows.add(f"{each}, {width} x {height}", partial(make, each, width, height, options))
    publish("Frames of baked scenes", str(rows), notes, arguments.output)
