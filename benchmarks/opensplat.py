#!/usr/bin/env python
"""Compare CPU seconds to each PSNR on the `fox` capture: our training curves against OpenSplat's.

OpenSplat 1.2.0 is a multi-threaded CPU trainer of 3D Gaussians in C++. Its curve below was measured once: built with
-march=native, 2 cores (AMD Zen 5), fox at 270x480, views 0, 8, 16, ... held out, 3,000 steps, densification from step
200 every 200 until 2,400; PSNR is the mean over the 7 held-out views, CPU seconds are the process's over all threads.
`ns-train bitymi --data fox` uses the same split and size.

For each PSNR that OpenSplat reaches, the table has the CPU seconds at which our run first reached it, by linear
interpolation between the points of its training_curve.jsonl; "<=" where its first point has it already.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from common import number, page, publish, table
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bitymi_ns.measure.bench.engine import read_curve

OPENSPLAT: tuple[tuple[int, float, int, float], ...] = (
    (200, 45, 12_359, 19.66),
    (600, 156, 23_047, 19.75),
    (1_000, 283, 36_194, 22.28),
    (1_400, 434, 47_110, 24.15),
    (1_600, 523, 51_872, 24.88),
    (2_000, 703, 58_723, 25.41),
    (2_400, 889, 62_066, 27.58),
    (3_000, 1_154, 62_066, 27.74),
)
"""Step, CPU seconds, Gaussians, PSNR in dB."""
Points = list[dict[str, Any]]
NOTES = (
    "OpenSplat's curve was measured on 2 cores (AMD Zen 5); the line above names the machine that made this table, not "
    "necessarily the one that trained.",
    "Our CPU seconds are those of the training steps alone: no loading, evaluation or saving. Points of our curve but "
    "the last are means over a sample of the held-out views where there are more than `curve_views`.",
)


def first_reached(points: Points, level: float) -> tuple[str, float, float] | None:
    """Mark ("" or "<= "), CPU seconds and surfels where a curve first reaches a PSNR; None if it never does."""
    for i, point in enumerate(points):
        if point["psnr"] < level:
            continue
        if i == 0:
            return "" if point["psnr"] == level else "<= ", point["cpu_seconds"], point["surfels"]
        before = points[i - 1]
        share = (level - before["psnr"]) / (point["psnr"] - before["psnr"])
        cpu, surfels = (before[k] + share * (point[k] - before[k]) for k in ("cpu_seconds", "surfels"))
        return "", cpu, surfels
    return None


def report(runs: dict[str, Points]) -> str:
    """A table by PSNR of OpenSplat's curve, and one of the ends of all curves."""
    header = ["PSNR", "OpenSplat CPU s", "Gaussians"]
    for name in runs:
        header += [f"{name}: CPU s", "ratio", "surfels"]
    rows = []
    for _, cpu, gaussians, psnr in OPENSPLAT:
        row = [number(psnr), number(cpu, 0), number(gaussians, 0)]
        for points in runs.values():
            if reached := first_reached(points, psnr):
                mark, seconds, surfels = reached
                row += [mark + number(seconds, 1), mark + number(seconds / cpu, 3), number(surfels, 0)]
            else:
                row += ["not reached", "", ""]
        rows.append(row)
    steps, cpu, gaussians, psnr = OPENSPLAT[-1]
    ends = [(f"OpenSplat 1.2.0, {steps:,} steps", psnr, cpu, gaussians)]
    ends += [
        (name, points[-1]["psnr"], points[-1]["cpu_seconds"], points[-1]["surfels"]) for name, points in runs.items()
    ]
    last = [
        [name, number(p), number(seconds, 0), number(seconds / cpu), number(count, 0), number(count / gaussians)]
        for name, p, seconds, count in ends
    ]
    ends_header = ("at the end", "PSNR", "CPU s", "of OpenSplat's", "primitives", "of OpenSplat's")
    return table(header, rows, ()) + "\n\n" + table(ends_header, last)


def plot(runs: dict[str, Points], path: Path) -> None:
    """PSNR against CPU seconds."""
    figure = Figure(figsize=(7.0, 4.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.plot([p[1] for p in OPENSPLAT], [p[3] for p in OPENSPLAT], "s--", color="0.45", label="OpenSplat 1.2.0")
    for name, points in runs.items():
        axes.plot([p["cpu_seconds"] for p in points], [p["psnr"] for p in points], "o-", ms=3.5, label=name)
    axes.set(xscale="log", xlabel="CPU seconds (all threads, logarithmic)", ylabel="PSNR of held-out views, dB")
    axes.grid(True, which="both", alpha=0.25)
    axes.legend()
    FigureCanvasAgg(figure).print_figure(str(path))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("curves", nargs="+", type=Path, help="training_curve.jsonl of runs on fox")
    parser.add_argument("--output", type=Path, help="PNG of PSNR against CPU seconds; the tables go beside it (.md)")
    options = parser.parse_args()
    runs: dict[str, Points] = {}
    for path in options.curves:
        points = [p for p in read_curve(path) if isinstance(p.get("psnr"), (int, float))]
        if not points:
            parser.error(f"no point of {path} has a PSNR: train with held-out views")
        name = f"{points[-1].get('method_name', path.stem)}, {points[-1]['step']:,} steps"
        runs[name if name not in runs else f"{name}, {path}"] = points
    text = page("CPU seconds against OpenSplat on fox", report(runs), NOTES)
    publish(text, None if options.output is None else options.output.with_suffix(".md"))
    if options.output is not None:
        plot(runs, options.output.with_suffix(".png"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
