"""Section of gpu.py: frames of the baked renderer, stage by stage.

The scene of `harness.trained_like` with BC7 tiles of random texels, as large as the surfels are on screen, and the
weight bound of the presets; or bundles (--bundles), seen by three cameras around their middle. What a stage cannot do
without, with n surfels of which v are visible, b pairs of surfel and tile, f fragments, p pixels, K sites:

  prepare   56 n + (28 K + 132) v bytes: parameters, then rows of 96 bytes
  bin       88 n + 96 v + 34 b bytes: a sort of n by 32 bits, one of b by 16 bits
  draw      100 b + 12 p bytes; 60 f operations: planes 12, kernel 12, blending 12, texel and colour 24. The bytes are
            read from the second-level cache, which the rows fit in; each of a tile's four warps reads its own.

On a card 3840 x 2160 is drawn in any case. "frame" is the two stages launched by the host, "graph" the same as a CUDA
graph, "packed" that with 8 bits per channel instead of floats, "waited for" the time of a program that waits for
each frame. "ends at 1/512" is the packed graph where a pixel takes no more light at that transmittance instead of 1e-4,
which may change it by half an 8-bit step of the brightest colour; "differs" is by how much it does.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from common import number, say, table
from harness import Options, arithmetic_rate, attempt, failures, milliseconds, trained_like, with_launches
from torch import Tensor

from bitymi_ns.bundle import read_bundle
from bitymi_ns.codec.packing import pack
from bitymi_ns.ops.baked_cuda import Stage, Workspace, listed_pairs
from bitymi_ns.ops.constants import ALPHA_MIN, BETA_MAX, SUPPORT
from bitymi_ns.ops.reference.project import rotation
from bitymi_ns.scene.baked import FAST, BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera

LARGE = (3840, 2160)
TIMED = ("list", "draw", "frame", "graph", "packed", "alone", "early")
"""Timings of `measured`, in the order of the columns from "list ms" on."""
HEADER = (
    "scene", "size", "million pairs", "pairs/tile", "of discs across the camera's plane", "fragments/pixel",
    "list ms", "draw ms", "frame ms", "graph ms", "packed, graph ms", "packed, waited for ms",
    "ends at 1/512, graph ms", "differs, 8-bit steps", "frames/s", "G fragments/s", "draw: of fp32", "draw: of copy",
)  # fmt: skip


def frames(options: Options) -> str:
    """Every scene at every size."""
    rate = arithmetic_rate(options)
    rows = []
    sizes = [*options.sizes, *([LARGE] if options.device.type == "cuda" and LARGE not in options.sizes else [])]
    how = (options, rate)
    for width, height in sizes:
        for n in options.surfels:
            rows.append(attempt(f"{n:,} surfels, {width} x {height}", partial(_synthetic, n, width, height, *how)))
        for folder in options.bundles:
            rows.append(attempt(f"{folder}, {width} x {height}", partial(_bundle, folder, width, height, *how)))
    text = f"### Baked renderer\n\nfp32, measured by a product of matrices: {number(rate / 1e12, 1)} TFLOP/s.\n\n"
    return text + table(HEADER, list(filter(None, rows))) + failures()


def _synthetic(n: int, width: int, height: int, options: Options, rate: float) -> list[str]:
    scene, camera = textured(n, width, height, options.device)
    return _row(f"synthetic, {n:,}", scene, [camera], options, rate)


def _bundle(folder: Path, width: int, height: int, options: Options, rate: float) -> list[str]:
    bundle = read_bundle(folder, decode=options.device.type != "cuda")
    scene = bundle.scene.to(options.device)
    return _row(f"{Path(folder).name}, {len(bundle):,}", scene, around(bundle, width, height), options, rate)


def textured(n: int, width: int, height: int, device: torch.device) -> tuple[BakedScene, Camera]:
    """A trained-like scene with an atlas."""
    scene, camera = trained_like(n, width, height, torch.device("cpu"), texture=False)
    surfels = {name: value.detach().contiguous() for name, value in scene.surfels.items()}
    pixels = 6 * surfels["log_scales"].exp() * camera.K[0, 0] / surfels["means"][:, 2:]
    packing = pack(torch.exp2(torch.log2(pixels).ceil()).clamp(4, 64).long().numpy())
    g = torch.Generator().manual_seed(1)
    atlas = blocks = None
    if device.type == "cuda":
        blocks = torch.randint(
            0, 256, (packing.layers, packing.height // 4, packing.width // 4, 16), dtype=torch.uint8, generator=g
        )
        blocks[..., 0] = 0x40  # mode 6: any other bits are a valid block
    else:
        shape = (packing.layers, packing.height, packing.width, 4)
        atlas = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
    baked = BakedScene(
        surfels,
        "sv",
        torch.from_numpy(packing.tiles).contiguous(),
        atlas,
        offset=-0.2,
        scale=0.4,
        weight_bound=scene.config.weight_bound,
        blocks=blocks,
    )
    return baked.to(device), camera


def crossing(scene: BakedScene, camera: Camera) -> Tensor:
    """Discs that cross the camera's plane, [N] bool: they have no bounding box in the image.

    From the level sets sigma = 1/255 of the parameters in float64, not from a kernel's rows.
    """
    p = {name: value.detach().double().cpu() for name, value in scene.surfels.items()}
    viewmat = camera.viewmat.double().cpu()
    times = torch.sigmoid(p["opacity_logits"]) / ALPHA_MIN
    exponent = -1 / (BETA_MAX * torch.sigmoid(p["beta_raw"]))
    radius = SUPPORT * (1 - times.clamp(min=1) ** exponent).sqrt()
    depth = p["means"] @ viewmat[2, :3] + viewmat[2, 3]
    # half axes of the level set, camera z
    axes = (viewmat[2, :3] @ rotation(p["quats"])[:, :, :2]) * p["log_scales"].exp() * radius[:, None]
    return (depth > scene.near) & (times > 1) & (depth < axes.norm(dim=1))


def pairs_per_tile(workspace: Workspace, scene: BakedScene, camera: Camera) -> tuple[float, float]:
    """Pairs per screen tile of the latest frame, and those of discs across the camera's plane."""
    lists = listed_pairs(workspace, len(scene), 1, camera.width, camera.height)
    tiles, pairs = len(lists.ranges), lists.pairs[: workspace.pairs]
    return len(pairs) / tiles, int(crossing(scene, camera).to(pairs.device)[pairs >> 8].sum()) / tiles


def measured(scene: BakedScene, cameras: Sequence[Camera], options: Options) -> dict[str, float]:
    """Means over cameras of one size: pairs of surfel and tile, fragments, and the milliseconds of each column of the
    table from `list` to `packed, waited for` ("alone") and of the frame whose pixels end early ("early"); and by how
    many 8-bit steps this differs at most."""
    width, height = cameras[0].width, cameras[0].height
    card = options.device.type == "cuda"
    sums = dict.fromkeys(("pairs", "per_tile", "across", "fragments", *TIMED), 0.0)
    ending = replace(scene, transmittance_min=FAST)
    for camera in cameras:
        sums["fragments"] += float(scene.render_views([camera], None, ("overdraw",))["overdraw"].sum())
        frame = BakedRenderer(scene, width, height)
        recorded = BakedRenderer(scene, width, height, graph=card)
        packed = BakedRenderer(scene, width, height, images=("packed",), graph=card)
        early = BakedRenderer(ending, width, height, images=("packed",), graph=card)
        for renderer in (frame, recorded, packed, early):
            renderer.draw([camera])
        sums["pairs"] += frame.workspace.pairs
        per_tile, across = pairs_per_tile(frame.workspace, scene, camera)
        sums["per_tile"] += per_tile
        sums["across"] += across
        cases: list[tuple[str, Callable[[], object]]] = [
            ("list", lambda frame=frame: frame.run(Stage.LIST)),
            ("draw", lambda frame=frame: frame.run(Stage.DRAW)),
            ("frame", frame.run),
            ("graph", recorded.run),
            ("packed", packed.run),
            ("early", early.run),
        ]
        for stage, run in cases:
            sums[stage] += milliseconds(run, options)
        sums["alone"] += with_launches(packed.run, options)
    images = [drawn.render_views(cameras, None, ("rgb",))["rgb"] for drawn in (scene, ending)]
    steps = 255.0 * float((images[0] - images[1]).abs().max())
    return {key: value / len(cameras) for key, value in sums.items()} | {"steps": steps}


def _row(name: str, scene: BakedScene, cameras: list[Camera], options: Options, rate: float) -> list[str]:
    width, height, mean = cameras[0].width, cameras[0].height, measured(scene, cameras, options)
    say(f"baked, {name} surfels, {width} x {height}: {mean['graph']:.3f} ms")
    pixels, draw = width * height, 1e-3 * mean["draw"]
    return [
        name,
        f"{width} x {height}",
        number(mean["pairs"] / 1e6, 2),
        number(mean["per_tile"], 1),
        number(mean["across"], 1),
        number(mean["fragments"] / pixels, 1),
        *(number(mean[key], 3) for key in TIMED),
        number(mean["steps"], 2),
        number(1e3 / mean["graph"], 0),
        number(mean["fragments"] / draw / 1e9, 1),
        f"{100 * 60 * mean['fragments'] / draw / rate:.0f} %",
        f"{100 * (100 * mean['pairs'] + 12 * pixels) / draw / options.copy_bytes:.0f} %",
    ]


def around(bundle, width: int, height: int) -> list[Camera]:
    """Three cameras around the middle of a bundle; training scales the cameras of a capture to the unit ball."""
    middle = bundle.scene.surfels["means"].median(dim=0).values
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    cameras = []
    for angle in (0.0, 2.1, 4.2):
        eye = middle + 0.7 * torch.tensor([math.cos(angle), math.sin(angle), 0.3])
        forward = torch.nn.functional.normalize(middle - eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        cameras.append(Camera(viewmat, K, width, height))
    return cameras
