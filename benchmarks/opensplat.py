#!/usr/bin/env python
"""CPU seconds to each PSNR on the `fox` capture: our training curves against OpenSplat's.

OpenSplat 1.2.0 is a multi-threaded CPU trainer of 3D Gaussians in C++. Its curve below was measured once: built with
-march=native, 2 cores (AMD Zen 5), fox at 270x480, views 0, 8, 16, ... held out, 3,000 steps, densification from step
200 every 200 until 2,400; PSNR is the mean over the 7 held-out views, CPU seconds are the process's over all threads.
The same split and size is what `ns-train bitymi --data fox` uses.

For each PSNR that OpenSplat reaches, the table has the CPU seconds at which our run first reached it, by linear
interpolation between the points of its training_curve.jsonl. A run that has it at its first point reached it at or
before that point: the table then says "<=".
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import CommandFailed, number, page, publish, read_curve, say, table

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


@dataclass(frozen=True)
class Run:
    """One of our runs."""

    name: str
    points: list[dict[str, Any]]
    """Of its curve, by step; those with a PSNR."""


@dataclass(frozen=True)
class Reached:
    """When a run first had a PSNR."""

    cpu_seconds: float
    surfels: float
    exact: bool
    """False: it had it at its first point already, so this is an upper bound."""


def first_reached(points: list[dict[str, Any]], level: float) -> Reached | None:
    """Where a curve first reaches `level`, interpolated linearly; None when it never does."""
    for i, point in enumerate(points):
        if point["psnr"] < level:
            continue
        if i == 0:
            return Reached(point["cpu_seconds"], point["surfels"], point["psnr"] == level)
        before = points[i - 1]
        share = (level - before["psnr"]) / (point["psnr"] - before["psnr"])
        cpu, surfels = (before[k] + share * (point[k] - before[k]) for k in ("cpu_seconds", "surfels"))
        return Reached(cpu, surfels, True)
    return None


def load(path: Path) -> Run:
    """A run from its training_curve.jsonl, or from the folder that holds it.

    Raises:
        CommandFailed: it holds no point with a PSNR.
    """
    file = path / "training_curve.jsonl" if path.is_dir() else path
    points = [p for p in read_curve(file) if isinstance(p.get("psnr"), (int, float))]
    if not points:
        raise CommandFailed(f"no point of {file} has a PSNR: train with held-out views")
    return Run(f"{points[-1].get('method_name', file.stem)}, {points[-1]['step']:,} steps", points)


def named_apart(runs: list[Run]) -> list[Run]:
    """The same runs with different names."""
    names = [run.name for run in runs]
    return [
        Run(f"{run.name} ({names[: i + 1].count(run.name)})" if names.count(run.name) > 1 else run.name, run.points)
        for i, run in enumerate(runs)
    ]


def levels_table(runs: list[Run]) -> str:
    """A line a PSNR level of OpenSplat's curve."""
    header = ["PSNR", "OpenSplat CPU s", "Gaussians"]
    for run in runs:
        header += [f"{run.name}: CPU s", "ratio", "surfels"]
    rows = []
    for _, cpu, gaussians, psnr in OPENSPLAT:
        row = [number(psnr), number(cpu, 0), number(gaussians, 0)]
        for run in runs:
            reached = first_reached(run.points, psnr)
            if reached is None:
                row += ["not reached", "", ""]
                continue
            mark = "" if reached.exact else "<= "
            row += [
                mark + number(reached.cpu_seconds, 1),
                mark + number(reached.cpu_seconds / cpu, 3),
                number(reached.surfels, 0),
            ]
        rows.append(row)
    return table(header, rows, ())


def final_table(runs: list[Run]) -> str:
    """Where everyone ends."""
    steps, cpu, gaussians, psnr = OPENSPLAT[-1]
    rows = [[f"OpenSplat 1.2.0, {steps:,} steps", number(psnr), number(cpu, 0), "1.00", number(gaussians, 0), "1.00"]]
    for run in runs:
        last = run.points[-1]
        rows.append(
            [
                run.name,
                number(last["psnr"]),
                number(last["cpu_seconds"], 0),
                number(last["cpu_seconds"] / cpu),
                number(last["surfels"], 0),
                number(last["surfels"] / gaussians),
            ]
        )
    return table(("at the end", "PSNR", "CPU s", "of OpenSplat's", "primitives", "of OpenSplat's"), rows)


def plot(runs: list[Run], path: Path) -> None:
    """PSNR against CPU seconds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7.0, 4.2), dpi=150, layout="constrained")
    axes.plot([p[1] for p in OPENSPLAT], [p[3] for p in OPENSPLAT], "s--", color="0.45", label="OpenSplat 1.2.0")
    for run in runs:
        axes.plot([p["cpu_seconds"] for p in run.points], [p["psnr"] for p in run.points], "o-", ms=3.5, label=run.name)
    axes.set_xscale("log")
    axes.set_xlabel("CPU seconds (all threads, logarithmic)")
    axes.set_ylabel("PSNR of held-out views, dB")
    axes.grid(True, which="both", alpha=0.25)
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    pyplot.close(figure)
    say(f"wrote {path}")


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument(
        "--curve",
        type=Path,
        action="append",
        required=True,
        help="training_curve.jsonl of a run on fox, or its folder; repeat for more runs",
    )
    parser.add_argument("--output", type=Path, help="PNG of PSNR against CPU seconds; the tables go beside it (.md)")
    options = parser.parse_args()
    try:
        runs = named_apart([load(path) for path in options.curve])
    except CommandFailed as error:
        say(str(error))
        return 1
    notes = [
        "OpenSplat's curve was measured on 2 cores (AMD Zen 5); the line above names the machine that made this table, "
        "not necessarily the one that trained.",
        "Our CPU seconds are those of the training steps alone: no loading, evaluation or saving. Points of our curve "
        "but the last are means over a sample of the held-out views where there are more than `curve_views`.",
    ]
    text = page("CPU seconds against OpenSplat on fox", levels_table(runs) + "\n\n" + final_table(runs), notes)
    publish(text, None if options.output is None else options.output.with_suffix(".md"))
    if options.output is not None:
        plot(runs, options.output.with_suffix(".png"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
