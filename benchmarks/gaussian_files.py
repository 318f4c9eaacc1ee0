#!/usr/bin/env python
"""What 3D Gaussians of another trainer cost as files and show of held-out views: PLY, compressed PLY, SOG, SPZ.

The PLY file of a trained scene, in the capture's own frame, is written in every form by splat-transform (npm), read
back from that by it, and drawn by `bitymi_ns.interchange.draw_gaussians`. Smaller ones: with fewer Gaussians, merged in
pairs (`--decimate`), and with fewer bands of harmonics. Each is a line of gaussians.jsonl in the work folder, which
`bundles.py --plot` reads; what is there is not done again.

`--principal X Y` draws with that principal point in place of the cameras', for trainers that take it for the middle of
the picture; `--background` over what the trainer had behind the scene. `--own` states how exact that is.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from bundles import METRICS, Results, load
from common import number, page, publish, say, table
from PIL import Image
from plain_capture import Capture
from torch import Tensor

from bitymi_ns.interchange.frame import Similarity
from bitymi_ns.interchange.gaussians import Gaussians, read_gaussians
from bitymi_ns.interchange.splat import draw_gaussians
from bitymi_ns.plugin.run.metrics import image_metrics
from bitymi_ns.train.losses import psnr
from bitymi_ns.train.views import as_float

COLUMNS = ("scene", "harmonics", "kept", "form", "Gaussians", "bytes", "each", "PSNR", "SSIM", "FLIP")
NEAR = 0.01
"""Nearest depth that is drawn, in units of the cameras' extent."""


@dataclass(frozen=True)
class Form:
    """A file to make.

    Attributes:
        suffix: of its name.
        bands: highest degree of the harmonics.
        kept: share of the Gaussians, percent.
    """

    suffix: str
    bands: int = 3
    kept: int = 100

    @classmethod
    def of(cls, text: str) -> Form:
        """Of SUFFIX, SUFFIX:BANDS or SUFFIX:BANDS:PERCENT."""
        suffix, *numbers = text.split(":")
        return cls(suffix, *map(int, numbers))


class Transform:
    """splat-transform.

    Attributes:
        command: that starts it.
    """

    def __init__(self, command: str) -> None:
        self.command = shlex.split(command)

    def __call__(self, *arguments: str | Path) -> None:
        subprocess.run([*self.command, "-q", "-w", *map(str, arguments)], check=True)

    def make(self, source: Path, form: Form, folder: Path) -> tuple[int, Path]:
        """Bytes of the file, and a PLY file of what it holds."""
        thinned = source
        if form.kept < 100:
            thinned = folder / f"{source.stem}-{form.kept}.ply"
            if not thinned.is_file():
                self(source, "--decimate", f"{form.kept}%", thinned)
        name = f"{source.stem}-{form.kept}-{form.bands}"
        made, back = folder / f"{name}.{form.suffix}", folder / f"{name}-{form.suffix}.ply"
        self("-g", "cpu", thinned, "--filter-harmonics", str(form.bands), made)
        self(made, back)
        return made.stat().st_size, back


class Judge:
    """Draws Gaussians as the trainer did, on the held-out views of a capture.

    Attributes:
        principal: of all cameras, in place of their own, pixels.
        background: [3].
    """

    def __init__(self, capture: Capture, principal: list[float] | None, background: list[float]) -> None:
        self._frame = Similarity(torch.eye(3, dtype=torch.float64), capture.scale, -capture.scale * capture.middle)
        self._views, self._principal, self._background = capture.held_out, principal, torch.tensor(background)

    def picture(self, gaussians: Gaussians, row: int) -> Tensor:
        """[H, W, 3] of a held-out view."""
        camera = self._views[row].camera
        K = camera.K.clone()
        if self._principal is not None:
            K[:2, 2] = torch.tensor(self._principal)
        moved = gaussians.moved(self._frame)
        return draw_gaussians(moved, replace(camera, K=K), self._background, NEAR).clamp(0.0, 1.0)

    def quality(self, gaussians: Gaussians) -> dict[str, float]:
        """Means over the views."""
        rows = []
        for row, view in enumerate(self._views):
            target = view.target(self._background, "cpu")
            rows.append(image_metrics(self.picture(gaussians, row), target, view.mask))
        return {name: fmean(row[name] for row in rows) for name in METRICS}

    def against(self, gaussians: Gaussians, path: Path) -> str:
        """How far our picture of the first held-out view, or a part of it from its lower right corner, is from the
        trainer's own."""
        own = as_float(torch.from_numpy(np.array(Image.open(path).convert("RGB"))))
        views = (self.picture(gaussians, 0), self._views[0].target(self._background, "cpu"))
        ours, photograph = (image[-own.shape[0] :, -own.shape[1] :] for image in views)
        return (
            f"The trainer's own picture has {psnr(own, photograph):.3f} dB, ours of the same Gaussians "
            f"{psnr(ours, photograph):.3f} dB; they differ by {psnr(ours, own):.2f} dB."
        )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--ply", type=Path, required=True, help="trained Gaussians, in the capture's own frame")
    parser.add_argument("--data", type=Path, required=True, help="folder of the capture")
    parser.add_argument("--transform", default="npx splat-transform", help="command of splat-transform (%(default)s)")
    parser.add_argument("--work", type=Path, default=Path("outputs/bundles"), help="what is kept (%(default)s)")
    parser.add_argument(
        "--forms", nargs="+", default=["ply", "compressed.ply", "sog", "spz"],
        help="SUFFIX[:BANDS[:PERCENT]] (%(default)s)",
    )  # fmt: skip
    parser.add_argument("--downscale", type=int, default=1, help="of the photographs (%(default)s)")
    parser.add_argument("--principal", nargs=2, type=float, metavar=("X", "Y"), help="in pixels")
    parser.add_argument("--background", nargs=3, type=float, default=[0.0, 0.0, 0.0], metavar=("R", "G", "B"))
    parser.add_argument(
        "--own", nargs=2, metavar=("PLY", "PICTURE"), help="also compare with the trainer's picture of such Gaussians"
    )
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    judge, transform = (
        Judge(load(options.data, options.downscale), options.principal, options.background),
        Transform(options.transform),
    )
    options.work.mkdir(parents=True, exist_ok=True)
    results = Results(options.work / "gaussians.jsonl")
    notes = [] if options.own is None else [judge.against(read_gaussians(options.own[0]), Path(options.own[1]))]
    scene, rows = options.data.name, []
    for form in map(Form.of, options.forms):
        key = {"scene": scene, "bands": form.bands, "kept": form.kept, "form": form.suffix}
        line = results.find(**key)
        if line is None:
            say(str(key))
            size, back = transform.make(options.ply, form, options.work)
            gaussians = read_gaussians(back)
            line = {**key, "count": len(gaussians), "bytes": size, **judge.quality(gaussians)}
            results.add(line)
        quality = [number(line["psnr"], 3), number(line["ssim"], 4), number(line["flip"], 4)]
        each = number(line["bytes"] / line["count"], 1)
        rows.append([scene, f"degree {form.bands}", f"{form.kept} %", form.suffix, f"{line['count']:,}",
                     f"{line['bytes']:,}", each, *quality])  # fmt: skip
        say(" ".join(rows[-1]))
    publish(page("Gaussians of another trainer as files", table(COLUMNS, rows, (0, 1, 2, 3)), notes), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
