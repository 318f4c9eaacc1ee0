#!/usr/bin/env python
"""Random restarts: one small scene, trained with many seeds. How far do results spread, and does any run break?

The scene is the demo room, ray-traced small (`bitymi_ns.sample`), with every 7th view held out. A seed decides the
order of the views, the start of the texture field and every draw of the densification; the points to start from are
drawn anew as well.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from common import number, page, publish, say, table

from bitymi_ns.sample import capture
from bitymi_ns.sample.room import Room
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import LearningRates, TrainConfig
from bitymi_ns.train.divergence import TrainingDiverged, describe_broken
from bitymi_ns.train.domain import build_scene
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.views import View

HOLD_OUT = 7
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes to OpenCV's


@dataclass(frozen=True)
class Result:
    """One run."""

    seed: int
    psnr: float
    surfels: int
    finite: bool
    rollbacks: int
    cpu_seconds: float
    note: str = ""


def room_views(width: int, height: int, count: int, points: int, seed: int):
    """Training views, held-out views, and the points [M, 3] and colours [M, 3] to start from."""
    room = Room(0)
    path = capture.camera_path(count, width, height, 0)
    images = [capture.render(room, view) for view in path]
    views = []
    for view, image in zip(path, images, strict=True):
        viewmat = torch.from_numpy(np.linalg.inv(view.camera_to_world @ FLIP)).float()
        K = torch.tensor([[view.focal, 0, width / 2], [0, view.focal, height / 2], [0, 0, 1]], dtype=torch.float32)
        views.append(View(Camera(viewmat, K, width, height), torch.from_numpy(image).float() / 255, None))
    held_out = [i for i in range(count) if i % HOLD_OUT == HOLD_OUT // 2]
    used = [i for i in range(count) if i not in held_out]
    xyz, rgb = capture.sparse_points(room, [path[i] for i in used], [images[i] for i in used], points, seed)
    return (
        [views[i] for i in used],
        [views[i] for i in held_out],
        torch.from_numpy(xyz).float(),
        torch.from_numpy(rgb).float() / 255,
    )


def run(seed: int, options: argparse.Namespace) -> Result:
    """Train once."""
    train, held_out, points, colors = room_views(options.width, options.height, options.views, options.points, seed)
    config = TrainConfig(seed=seed, lr=LearningRates().times(options.rates))
    scene_config = SceneConfig(prefilter=options.prefilter)
    centers = torch.stack([view.camera.center for view in train])
    pixels = len(train) * options.width * options.height
    scene, _ = build_scene(points, colors, centers, scene_config, config, True, pixels)
    trainer, note = Trainer(scene, train, config, options.steps), ""
    start = time.process_time()
    try:
        while trainer.step < options.steps:
            trainer.advance()
    except TrainingDiverged as error:
        note = str(error)
    psnr, *_ = evaluate(scene, held_out, config)
    rollbacks = trainer.training.guard.rollbacks
    finite = not describe_broken(scene) and math.isfinite(psnr)
    return Result(seed, psnr, len(scene), finite, rollbacks, time.process_time() - start, note)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="number of runs (%(default)s)")
    parser.add_argument("--steps", type=int, default=300, help="length of a run (%(default)s)")
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--height", type=int, default=72)
    parser.add_argument("--views", type=int, default=28)
    parser.add_argument("--points", type=int, default=1200)
    parser.add_argument("--rates", type=float, default=1.0, help="factor on every learning rate (%(default)s)")
    parser.add_argument("--prefilter", choices=("low_pass", "pixel"), default="low_pass")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    results = []
    for seed in range(options.seeds):
        results.append(run(seed, options))
        say(f"seed {seed}: {results[-1]}")
    rows = [
        [str(r.seed), number(r.psnr), number(r.surfels, 0), "yes" if r.finite else "**no**", str(r.rollbacks),
         number(r.cpu_seconds, 1), r.note]
        for r in results
    ]  # fmt: skip
    psnr = [r.psnr for r in results if r.finite]
    notes = [f"{sum(not r.finite for r in results)} of {len(results)} runs end with a number that is not finite."]
    if psnr:
        spread = statistics.pstdev(psnr)
        notes.append(
            f"PSNR {statistics.mean(psnr):.2f} dB on average, standard deviation {spread:.2f} dB, "
            f"{min(psnr):.2f} to {max(psnr):.2f} dB."
        )
    header = ("seed", "PSNR", "surfels", "all finite", "rollbacks", "CPU s", "ended with")
    publish(page(f"{options.seeds} seeds", table(header, rows), notes), options.output)
    return 1 if any(not r.finite for r in results) else 0


if __name__ == "__main__":
    sys.exit(main())
