#!/usr/bin/env python
"""How a training step and its memory grow with photographs, their pixels, and surfels.

Every row is a process of its own, one thread, which makes a few steps of each part of a run on a capture as it stands
at the start (surfels of a tenth opacity at the points: more fragments than later). In turn one of the three is reduced:
every second and fourth photograph, half and a quarter of width and height, a half and a quarter of the points. An
exponent e says that a column grows as the power e of what is varied (least squares of the logarithms).

  step      CPU seconds of a step in which surfels alone learn; the mean over the steps
  begin     CPU seconds until every surfel has its tile
  texels    million of them; of a run of `--steps` steps
  textured  CPU seconds of a step in which texels learn, too
  peak      GB of the process, in the first part and in all
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")

import numpy as np
import torch
from common import number, page, publish, say, table
from plain_capture import load_capture

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.domain import build_scene
from bitymi_ns.train.fit import Trainer

REDUCED = (1, 2, 4)
MEASURED = ("fragments", "step", "begin", "texels", "textured", "peak, surfels", "peak")
HEADS = ("photographs", "pixels", "surfels", *MEASURED)


@dataclass(frozen=True)
class Cell:
    """Every which photograph, width and height divided by, every which point."""

    photographs: int = 1
    pixels: int = 1
    surfels: int = 1


def cells() -> list[Cell]:
    """The whole capture, and each of the three reduced alone."""
    varied = (Cell(**{name: k}) for name in ("photographs", "pixels", "surfels") for k in REDUCED[1:])
    return [Cell(), *varied]


def measure(data: Path, cell: Cell, downscale: int, steps: int, repeats: int) -> dict[str, float]:
    """The figures of a row, in this process."""
    torch.set_num_threads(1)
    capture = load_capture(data, downscale=downscale * cell.pixels)
    views = capture.train[:: cell.photographs]
    cameras = [view.camera for view in views]
    pixels = [camera.width * camera.height for camera in cameras]
    config = TrainConfig(num_downscales=0, first_surfels=len(capture.points) // cell.surfels)
    centers = torch.stack([camera.center for camera in cameras])
    scene, _ = build_scene(
        capture.points, capture.colours, centers, SceneConfig(texture="texels"), config, False, sum(pixels)
    )
    trainer = Trainer(scene, views, config, steps)
    schedule = trainer.training.schedule
    quiet = [
        s for s in range(1, schedule.texels_start) if not (schedule.is_densify_step(s) or schedule.is_reset_step(s))
    ]
    surfels = len(scene)
    trainer.advance()  # what is made once
    fragments, begun = [], time.process_time()
    for step in quiet[:repeats]:
        trainer.step = step
        fragments.append(len(trainer.advance()[1].fragments))
    row = {"photographs": len(views), "pixels": max(pixels), "surfels": surfels}
    row |= {"fragments": sum(fragments) / len(fragments) / 1e6, "step": (time.process_time() - begun) / repeats}
    row["peak, surfels"] = _peak()
    trainer.step, begun = schedule.texels_start, time.process_time()
    trainer.training.begin(trainer.step)
    row |= {"begin": time.process_time() - begun, "texels": len(scene.field.texels) / 1e6}
    trainer.advance()
    begun = time.process_time()
    for _ in range(repeats):
        trainer.advance()
    return row | {"textured": (time.process_time() - begun) / repeats, "peak": _peak()}


def exponent(varied: list[float], measured: list[float]) -> float:
    """e of the least-squares fit measured ~ varied^e."""
    return float(np.polyfit(np.log(varied), np.log(measured), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="capture with a transforms.json")
    parser.add_argument("--downscale", type=int, default=1, help="of all photographs, before they are reduced")
    parser.add_argument("--steps", type=int, default=1200, help="length of the run whose steps are measured")
    parser.add_argument("--repeats", type=int, default=6, help="steps that are measured of each part")
    parser.add_argument("--output", type=Path, help="file for the page")
    parser.add_argument("--cell", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cell is not None:
        cell = Cell(**options.cell)
        print(json.dumps(measure(options.data, cell, options.downscale, options.steps, options.repeats)))
        return
    rows = {}
    for cell in cells():
        command = [sys.executable, __file__, str(options.data), "--steps", str(options.steps)]
        command += [
            "--downscale",
            str(options.downscale),
            "--repeats",
            str(options.repeats),
            "--cell",
            json.dumps(vars(cell)),
        ]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        rows[cell] = json.loads(done.stdout.splitlines()[-1])
        say(f"{cell}: {rows[cell]}")
    shown = [[number(row[name], 0 if name in HEADS[:3] else 2) for name in HEADS] for row in rows.values()]
    for name in ("photographs", "pixels", "surfels"):
        varied = [row for cell, row in rows.items() if cell == Cell() or getattr(cell, name) > 1]
        fits = [exponent([r[name] for r in varied], [r[column] for r in varied]) for column in MEASURED]
        shown.append([f"exponent of {name}", "", "", *(number(e, 2) if math.isfinite(e) else "" for e in fits)])
    publish(page("How a training step grows", table(HEADS, shown)), options.output)


def _peak() -> float:
    """GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    main()
