#!/usr/bin/env python
"""What each part of the method is worth on one capture: falloff loss, view colour, texture, freezing.

Every row is a training run of its own (ns-train, then ns-eval of the trained scene). Finished cells are kept in --work
and not done again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from common import Bench, CommandFailed, Settings, add_run_options, number, page, publish, say, table

LOSS = "--pipeline.model.train.loss"
VARIANTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "default: falloff 0.005, SV, texture, freezing": ("bitymi", ()),
    "falloff 0": ("bitymi", (f"{LOSS}.falloff-weight", "0.0")),
    "falloff 0.001": ("bitymi", (f"{LOSS}.falloff-weight", "0.001")),
    "falloff moves beta only": ("bitymi", (f"{LOSS}.falloff-gradient", "beta_only")),
    "view colour SH": ("bitymi-sh", ()),
    "view colour SB": ("bitymi-sb", ()),
    "view colour SG": ("bitymi-sg", ()),
    "no texture": ("bitymi-notexture", ()),
    "no freezing": ("bitymi", ("--pipeline.model.train.freeze-every", "1")),
    "texture moves surfels": ("bitymi", ("--pipeline.model.scene.texture-moves-surfels", "True")),
}
"""Row -> method and options of ns-train."""
HEADER = (
    "variant",
    "PSNR",
    "SSIM",
    "FLIP",
    "surfels",
    "fragments/px",
    "render ms",
    "training s",
    "training CPU s",
)
NOTES = (
    "Every row differs from the default in what it names only. Means over the held-out views; render ms: the trained "
    "scene, one view, rendering alone; training seconds: the training steps alone.",
)


def measure(bench: Bench, settings: Settings, variant: str) -> tuple[list[str], list[str]]:
    """One line of the table, and the commits that made it."""
    train, metrics = bench.train(settings), bench.evaluate(settings)
    cells = [
        variant,
        number(metrics["psnr"]),
        number(metrics["ssim"], 4),
        number(metrics.get("flip"), 4),
        number(metrics["surfels"], 0),
        number(metrics["fragments_per_pixel"]),
        number(metrics.get("render_ms"), 1),
        number(train["seconds"], 0),
        number(train["cpu_seconds"], 0),
    ]
    return cells, [train["commit"], metrics["commit"]]


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of a capture")
    parser.add_argument("--only", metavar="TEXT", help="only rows whose name contains this")
    add_run_options(parser)
    options = parser.parse_args()
    bench, rows, commits, failed = Bench(options.work), [], [], []
    for variant, (method, extra) in VARIANTS.items():
        if options.only is not None and options.only not in variant:
            continue
        try:
            line, made = measure(
                bench, Settings(options.data, method, options.steps, (*extra, *options.extra)), variant
            )
        except CommandFailed as error:
            say(str(error))
            failed.append(f"{variant}: failed, see the messages above.")
            continue
        rows.append(line)
        commits += made
    title = f"Ablation on {options.data.resolve().name}"
    publish(page(title, table(HEADER, rows), [*NOTES, *failed], commits), options.output)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
