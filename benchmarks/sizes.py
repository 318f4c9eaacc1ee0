#!/usr/bin/env python
"""A baked scene at other sizes than the photographs: held-out views drawn smaller and larger, and a camera that backs
away.

Columns of the first table, dB over the held-out views, against photographs reduced to the size (area average):
  before    one sample per pixel, kernel and texels as at the photographs' size
  now       as `BakedScene.render` draws
  averaged  drawn at the photographs' size, area average; larger views: the photographs' size enlarged bilinearly
  to avg    `now` against `averaged`
CPU ms: of one thread, least of some repeats. Of the second: the mean absolute difference between frames that follow
each other, in 8-bit steps, of all three; how far the differences are from those of the averaged frames; and the step at
which `now` exceeds `averaged` the most.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")

import numpy as np
import torch
from common import cpu_milliseconds, number, page, publish, say, table
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.photo_resolution import photographed
from bitymi_ns.ops.baked import draw
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.sampling import averaged, size_of
from bitymi_ns.train.evaluate import evenly_spaced
from bitymi_ns.train.losses import psnr
from bitymi_ns.train.views import View, as_float, downscale_image

SIZES = ("scene", "size", "before", "now", "averaged", "to avg", "before, ms", "now, ms", "samples", "blended, million")
FLICKER = ("scene", "to size", "before", "now", "averaged", "before, off", "now, off", "worst step", "averaged there")
MEASURED = FLICKER[2:7]
FRAMES = 60


class Bundle:
    """A bundle, its held-out views, and the three ways of drawing it."""

    def __init__(self, folder: Path, views: int, large: Path | None) -> None:
        _, pipeline, _, _ = eval_setup(folder / "config.yml", test_mode="test")
        data, model = pipeline.datamanager, pipeline.model
        self.name, self.large = folder.name, large
        self.background: Tensor = model.background.cpu()
        scene: BakedScene = model._scene.to("cpu")
        if scene.photographed is None:  # a bundle of an earlier version
            cameras = [view.camera for view in data.train_views]
            points = photographed(BakeInput(scene.surfels, cameras, scene.near, 0.0, scene.through_pixel))
            scene = replace(scene, photographed=points)
        self.scene = scene
        chosen = evenly_spaced(len(data.eval_views), views)
        self.views: list[View] = [data.eval_views[i] for i in chosen]
        self.files = [Path(data.eval_dataset.image_filenames[i]) for i in chosen]

    def _plain(self, camera: Camera, photo_pixel: float = 1.0) -> Tensor:
        return draw(self.scene, [camera], self.background, ("rgb",), photo_pixel)["rgb"][0].clamp(0.0, 1.0)

    def before(self, camera: Camera) -> Tensor:
        """As a view of the photographs' size."""
        return self._plain(camera)

    def now(self, camera: Camera) -> Tensor:
        """As it is drawn."""
        return self.scene.render(camera, self.background).rgb.clamp(0.0, 1.0)

    def averaged(self, camera: Camera, size: float) -> Tensor:
        """`size` of the photographs': drawn at theirs, then averaged, or enlarged."""
        if size > 1:
            small = self._plain(camera.scaled(1 / size)).movedim(2, 0)[None]
            return interpolate(small, (camera.height, camera.width), mode="bilinear")[0].movedim(0, 2)
        k = max(1, round(1 / size))
        return averaged({"rgb": self._plain(camera.scaled(k))[None]}, k)["rgb"][0]

    def photograph(self, i: int, camera: Camera) -> Tensor:
        """Of a held-out view, reduced to a camera's size; from the folder of large photographs if it has to be."""
        view = self.views[i]
        if camera.width <= view.camera.width:
            return downscale_image(view.target(self.background, "cpu"), camera.width, camera.height)
        assert self.large is not None
        found = next(self.large.rglob(self.files[i].name))
        image = as_float(torch.from_numpy(np.array(Image.open(found).convert("RGB"))))
        return downscale_image(image, camera.width, camera.height)


def sizes(bundle: Bundle, wanted: list[float], repeats: int) -> list[list[str]]:
    """Lines of the first table."""
    rows = []
    for size in wanted:
        found: dict[str, list[float]] = {key: [] for key in SIZES[2:]}
        for i, view in enumerate(bundle.views):
            camera = view.camera.scaled(size)
            photo = bundle.photograph(i, camera)
            before, before_ms = cpu_milliseconds(partial(bundle.before, camera), repeats)
            now, now_ms = cpu_milliseconds(partial(bundle.now, camera), repeats)
            truth = bundle.averaged(camera, size)
            overdraw = bundle.scene.render(camera, maps=True).overdraw
            values = (
                psnr(before, photo), psnr(now, photo), psnr(truth, photo), min(psnr(now, truth), 99.0), before_ms,
                now_ms, bundle.scene.sampling([camera]).samples, float(overdraw.sum()) / 1e6,
            )  # fmt: skip
            for key, value in zip(SIZES[2:], values, strict=True):
                found[key].append(value)
        digits = (2, 2, 2, 2, 1, 1, 1, 2)
        cells = [number(fmean(found[key]), n) for key, n in zip(SIZES[2:], digits, strict=True)]
        rows.append([bundle.name, f"{size:g}", *cells])
        say(" ".join(rows[-1]))
    return rows


def flicker(bundle: Bundle, farthest: float, folder: Path | None) -> list[str]:
    """A line of the second table: a camera that backs away until the scene is `farthest` times as large."""
    start = bundle.views[len(bundle.views) // 2].camera
    points = bundle.scene.photographed
    assert points is not None
    z = (points[:, :3] @ start.viewmat[:3, :3].T + start.viewmat[:3, 3])[:, 2]
    depth = float(z[z > 0].median())
    steps: dict[str, list[float]] = {name: [] for name in MEASURED}
    last: list[Tensor] | None = None
    for frame in range(FRAMES):
        viewmat = start.viewmat.clone()
        viewmat[2, 3] += depth * (farthest ** (-frame / (FRAMES - 1)) - 1)
        camera = Camera(viewmat, start.K, start.width, start.height)
        size = min(1.0, size_of(points, camera))
        frames = [bundle.before(camera), bundle.now(camera), bundle.averaged(camera, size)]
        if folder is not None and frame % 10 == 9:
            folder.mkdir(parents=True, exist_ok=True)
            picture = (torch.cat(frames, 1) * 255 + 0.5).to(torch.uint8).numpy()
            Image.fromarray(picture).save(folder / f"{bundle.name}_{frame:02d}.png")
        if last is not None:
            change = [255 * (now - then) for now, then in zip(frames, last, strict=True)]
            values = [float(c.abs().mean()) for c in change]
            values += [float((c - change[2]).abs().mean()) for c in change[:2]]
            for name, value in zip(MEASURED, values, strict=True):
                steps[name].append(value)
        last = frames
    line = [bundle.name, number(size, 2), *(number(fmean(steps[name]), 2) for name in MEASURED)]
    # where a change of the samples would show: the largest step of the path beside the averaged frames' own there
    jump, there = max(zip(steps["now"], steps["averaged"], strict=True), key=lambda pair: pair[0] - pair[1])
    line += [number(jump, 2), number(there, 2)]
    say(" ".join(line))
    return line


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--bundles", nargs="+", type=Path, required=True, help="folders")
    parser.add_argument("--sizes", nargs="+", type=float, default=[1.0, 0.5, 0.25, 0.125], help="(%(default)s)")
    parser.add_argument("--large", type=Path, help="folder of the same photographs, larger, for sizes above 1")
    parser.add_argument("--views", type=int, default=8, help="held-out views (%(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="of timings (%(default)s)")
    parser.add_argument("--away", type=float, default=0.125, help="how small the last frame is; 1: none (%(default)s)")
    parser.add_argument("--pictures", type=Path, help="folder for some frames: before, now, averaged")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows, lines = [], []
    with torch.no_grad():
        for folder in options.bundles:
            bundle = Bundle(folder, options.views, options.large)
            rows += sizes(bundle, options.sizes, options.repeats)
            if options.away < 1:
                lines.append(flicker(bundle, options.away, options.pictures))
    tables = [table(SIZES, rows, (0, 1)), *([table(FLICKER, lines)] if lines else [])]
    publish(page("Other sizes than the photographs'", "\n\n".join(tables)), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
