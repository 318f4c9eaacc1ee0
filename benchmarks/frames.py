#!/usr/bin/env python
"""What a frame of a bundle costs on each backend, counted: means over its held-out views at each size.

  in front   surfels whose centre lies in front of the camera's near plane and whose opacity is drawn at all
  across     of these, discs that cross the camera's plane (their image is no ellipse and has no box), and how many of
             them no border of the image excludes
  visible    surfels that are left after the preparation of the backend
  pairs      of surfel and screen tile, per tile of 16 x 16 pixels, and those of the discs across the plane
  tests      CUDA: pixels of the 8 x 4 parts that the masks of the pairs name; WebGPU: of the rectangles; per pixel
  fragments  that are blended, per pixel, and per test
  ms         CPU: of one thread, least of some repeats. WebGPU: until the picture is read. CUDA: on a card alone

The CUDA kernels run on a card where there is one, else emulated; WebGPU where the package wgpu and a driver are.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from common import cpu_milliseconds, number, publish, table
from torch import Tensor

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops import webgpu
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.ops.baked_cuda import Workspace, listed_pairs
from bitymi_ns.ops.constants import ALPHA_MIN, BETA_MAX, SUPPORT
from bitymi_ns.ops.reference.project import rotation
from bitymi_ns.ops.webgpu.draw import LAYERS
from bitymi_ns.ops.webgpu.on_device import SceneOnDevice
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera

HEADER = (
    "size", "backend", "in front", "across, not excluded", "visible", "pairs/tile", "across", "tests/pixel",
    "fragments/pixel", "per test", "ms",
)  # fmt: skip


class Discs(NamedTuple):
    """Masks [N] of a view: `front`, `across` and `open` as the page's text says."""

    front: Tensor
    across: Tensor
    open: Tensor


def discs(scene: BakedScene, camera: Camera) -> Discs:
    """Where the level sets sigma = 1/255 lie, from the parameters in float64 and not from a kernel's rows."""
    p = {name: scene.surfels[name].detach().double().cpu() for name in ("means", "quats", "log_scales")}
    opacity, beta = (torch.sigmoid(scene.surfels[name].double().cpu()) for name in ("opacity_logits", "beta_raw"))
    viewmat, K = camera.viewmat.double().cpu(), camera.K.double().cpu()
    centre = p["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    times = opacity / ALPHA_MIN
    radius = (SUPPORT**2 * (1 - times.clamp(min=1) ** (-1 / (BETA_MAX * beta)))).sqrt()
    # half axes of the level set in the camera's frame, [N, 3, 2]
    axes = viewmat[:3, :3] @ rotation(p["quats"])[:, :, :2] * (p["log_scales"].exp() * radius[:, None])[:, None]
    front = (centre[:, 2] > scene.near) & (times > 1)
    across = front & (centre[:, 2] < axes[:, 2].norm(dim=1))
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    not_excluded = across.clone()
    for plane in ((fx, 0, cx), (-fx, 0, camera.width - cx), (0, fy, cy), (0, -fy, camera.height - cy)):
        normal = torch.tensor(plane, dtype=torch.float64)
        not_excluded &= centre @ normal + (normal @ axes).norm(dim=1) >= 0
    return Discs(front, across, not_excluded)


def held_out(folder: Path, width: int) -> list[Camera]:
    """The held-out cameras of a bundle, scaled to a width."""
    cameras = []
    for c in json.loads((folder / "cameras.json").read_text("utf8"))["cameras"]:
        if c["held_out"]:
            by = width / c["width"]
            K = torch.tensor([[c["fx"] * by, 0, c["cx"] * by], [0, c["fy"] * by, c["cy"] * by], [0, 0, 1]])
            viewmat = torch.tensor(c["viewmat"]).reshape(4, 4)
            cameras.append(Camera(viewmat, K, width, round(c["height"] * by)))
    return cameras


class PairCounts(NamedTuple):
    """Of a frame of one view: visible surfels, pairs per screen tile, those of discs across the camera's plane, and
    pixels in the parts of tiles that the pairs name."""

    visible: int
    per_tile: float
    across: float
    tests: int


def pair_counts(workspace: Workspace, scene: BakedScene, camera: Camera) -> PairCounts:
    """What the latest frame left in the working memory, of the whole scene and of that view."""
    lists = listed_pairs(workspace, len(scene), 1, camera.width, camera.height)
    tiles, pairs = len(lists.ranges), lists.pairs[: workspace.pairs]
    parts = sum(int((pairs >> part & 1).sum()) for part in range(8))
    across = int(discs(scene, camera).across[pairs >> 8].sum())
    return PairCounts(int(lists.visible.sum()), len(pairs) / tiles, across / tiles, 32 * parts)


def on_cuda(scene: BakedScene, camera: Camera) -> list[float]:
    """Visible, pairs per tile, those across the plane, tests and fragments per pixel, nan."""
    renderer = BakedRenderer(scene, camera.width, camera.height, images=("overdraw",))
    fragments = float(renderer.draw([camera])["overdraw"].sum())
    counts, pixels = pair_counts(renderer.workspace, scene, camera), camera.width * camera.height
    return [counts.visible, counts.per_tile, counts.across, counts.tests / pixels, fragments / pixels, np.nan]


def on_webgpu(scene: SceneOnDevice, camera: Camera, repeats: int) -> list[float]:
    """As `on_cuda`, without pairs, with milliseconds."""
    fragments = float(scene.draw(camera, "overdraw", LAYERS)[..., 0].sum())
    rectangles = scene.rectangles()
    # their part of the screen, bounded by that of the box about each
    box = np.abs(rectangles[:, :2]) * rectangles[:, 4:5] + np.abs(rectangles[:, 1::-1]) * rectangles[:, 5:6]
    size = np.array([camera.width, camera.height], np.float32)
    shown = np.clip(rectangles[:, 2:4] + box, 0, size) - np.clip(rectangles[:, 2:4] - box, 0, size)
    tests = np.minimum(4 * rectangles[:, 4] * rectangles[:, 5], shown.prod(1)).sum(dtype=np.float64)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        scene.draw(camera, "color", LAYERS)
        times.append(1e3 * (time.perf_counter() - start))
    per_pixel = 1 / (camera.width * camera.height)
    return [len(rectangles), np.nan, np.nan, tests * per_pixel, fragments * per_pixel, statistics.median(times)]


def on_cpu(scene: BakedScene, camera: Camera, repeats: int) -> list[float]:
    """Fragments per pixel and milliseconds."""
    image, ms = cpu_milliseconds(lambda: scene.render(camera), repeats)
    fragments = float(scene.render(camera, maps=True).overdraw.double().mean())
    return [np.nan, np.nan, np.nan, np.nan, fragments, ms]


def rows_of(folder: Path, width: int, repeats: int) -> list[list[str]]:
    """A row for each backend."""
    scene = read_bundle(folder).scene
    card = torch.cuda.is_available()
    cameras = held_out(folder, width)
    backends = {"CPU": [on_cpu(scene, camera, repeats) for camera in cameras]}
    found = [discs(scene, camera) for camera in cameras]
    with nullcontext() if card else emulated_cuda():
        moved = scene.to("cuda") if card else scene
        backends["CUDA" if card else "CUDA, emulated"] = [on_cuda(moved, camera) for camera in cameras]
    try:
        webgpu.require()
        there = SceneOnDevice(scene)
        backends["WebGPU"] = [on_webgpu(there, camera, repeats) for camera in cameras]
    except webgpu.WebGpuUnavailable as error:
        print(f"without WebGPU: {error}", file=sys.stderr)
    front, across, not_excluded = (
        statistics.fmean(float(getattr(of, name).sum()) for of in found) for name in Discs._fields
    )
    shared = [f"{front:,.0f}", f"{across:,.0f}, {not_excluded:.1f}"]
    rows = []
    for backend, counts in backends.items():
        visible, pairs, of_across, tests, fragments, ms = np.mean(counts, axis=0)
        numbers = [
            (visible, 0),
            (pairs, 1),
            (of_across, 1),
            (tests, 1),
            (fragments, 1),
            (fragments / tests, 2),
            (ms, 1),
        ]
        cells = ["" if np.isnan(value) else number(float(value), digits) for value, digits in numbers]
        rows.append([f"{cameras[0].width} x {cameras[0].height}", backend, *shared, *cells])
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", nargs="+", type=Path, help="folders of bundles")
    parser.add_argument("--widths", nargs="+", type=int, default=[320, 1280], help="of the views, pixels")
    parser.add_argument("--repeats", type=int, default=3, help="of every timing")
    parser.add_argument("--output", type=Path, help="write the page there as well")
    options = parser.parse_args()
    torch.set_num_threads(1)
    text = ""
    for folder in options.bundles:
        rows = [row for width in options.widths for row in rows_of(folder, width, options.repeats)]
        text += f"## {folder.resolve().parent.name}/{folder.name}\n\n{table(HEADER, rows)}\n\n"
    publish(text, options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
