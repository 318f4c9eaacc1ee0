#!/usr/bin/env python
"""Quality, speed and size a capture: the trained scene and its bundles in every atlas format.

For each capture: ns-train, ns-export in fp16, uint8 and BC7, ns-eval of all four. Finished cells are kept in --work
and not done again. The dPSNR column is a bundle's PSNR minus that of the trained scene it was baked from.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from common import (
    FORMATS,
    Bench,
    CommandFailed,
    Settings,
    add_run_options,
    difference,
    number,
    page,
    publish,
    say,
    table,
)

HEADER = (
    "scene",
    "form",
    "PSNR",
    "SSIM",
    "FLIP",
    "surfels",
    "training s",
    "training CPU s",
    "process CPU s",
    "peak RSS MB",
    "render ms",
    "atlas bytes",
    "dPSNR",
)
NOTES = (
    "Training seconds: the training steps alone; process CPU seconds and peak RSS: ns-train from start to end, with "
    "loading, evaluation and saving.",
    "Means over the held-out views; render ms: one view, rendering alone.",
)


def row(scene: str, form: str, metrics: dict[str, Any], train: dict[str, Any] | None, neural: float) -> list[str]:
    """One line of the table; training figures stand in the line of the trained scene only."""
    cost = train or {}
    peak = cost.get("peak_bytes")
    return [
        scene,
        form,
        number(metrics["psnr"]),
        number(metrics["ssim"], 4),
        number(metrics.get("flip"), 4),
        number(metrics["surfels"], 0),
        number(cost.get("seconds"), 0),
        number(cost.get("cpu_seconds"), 0),
        number(cost.get("process_cpu_seconds"), 0),
        number(None if peak is None else peak / 1e6, 0),
        number(metrics.get("render_ms"), 1),
        "" if train else number(metrics.get("atlas_bytes"), 0),
        "" if train else difference(metrics["psnr"] - neural),
    ]


def measure(bench: Bench, settings: Settings) -> tuple[list[list[str]], list[str]]:
    """The lines of one capture, and the commits that made them."""
    train = bench.train(settings)
    neural = bench.evaluate(settings)
    made = [train["commit"], neural["commit"]]
    rows = [row(settings.scene, f"neural ({settings.method})", neural, train, neural["psnr"])]
    for atlas in FORMATS:
        made.append(bench.export(settings, atlas)["commit"])
        baked = bench.evaluate(settings, atlas)
        made.append(baked["commit"])
        rows.append(row(settings.scene, atlas, baked, None, neural["psnr"]))
    return rows, made


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--data", nargs="+", type=Path, required=True, help="folders of captures")
    parser.add_argument("--method", default="bitymi", help="what is trained (%(default)s)")
    add_run_options(parser)
    options = parser.parse_args()
    bench, rows, commits, failed = Bench(options.work), [], [], []
    for folder in options.data:
        settings = Settings(folder, options.method, options.steps, tuple(options.extra))
        try:
            lines, made = measure(bench, settings)
        except CommandFailed as error:
            say(str(error))
            failed.append(f"{settings.scene}: failed, see the messages above.")
            continue
        rows += lines
        commits += made
    publish(page("Captures", table(HEADER, rows, 2), [*NOTES, *failed], commits), options.output)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
