#!/usr/bin/env python
"""What fine-tuning the texels gains: trained runs, baked as they are and tuned, in several atlas formats.

Every run is baked once and tuned once, in this process; plain and tuned texels are then encoded in every format and
the bundles compared with the photographs of the held-out views. CPU s: of the tuning, all threads, with tracing the
training views.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")

import torch
import yaml
from common import number, page, publish, say, table

from bitymi_ns.bake import Baked, BakeOptions, TuneOptions, bake, tune_atlas
from bitymi_ns.bundle import export, read_bundle
from bitymi_ns.measure.bench.tables import difference
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.plugin.run.metrics import image_metrics
from bitymi_ns.plugin.run.preset import build
from bitymi_ns.train.views import View

METRICS = ("psnr", "ssim", "flip")
HEADER = (
    "scene", "format", "texels", "PSNR", "SSIM", "FLIP", "tuned PSNR", "SSIM", "FLIP", "dPSNR", "best step", "CPU s",
)  # fmt: skip


def quality(baked: Baked, views: list[View], background: torch.Tensor) -> dict[str, float]:
    """Mean metrics of a bundle's pictures of the views."""
    with tempfile.TemporaryDirectory() as folder:
        export(baked, Path(folder) / "bundle", background=background.tolist())
        scene = read_bundle(Path(folder) / "bundle").scene
    rows = []
    for view in views:
        rgb = scene.render(view.camera, background).rgb.clamp(0.0, 1.0)
        rows.append(image_metrics(rgb, view.target(background, "cpu"), view.mask))
    return {name: sum(row[name] for row in rows) / len(rows) for name in METRICS}


def measure(run: Path, formats: list[str], bake_options: BakeOptions, tune_options: TuneOptions) -> list[list[str]]:
    """The lines of one trained run."""
    _, pipeline = load_trained(run)
    model, data = pipeline.model, pipeline.datamanager
    background = model.background.cpu()
    train, evaluation = data.train_views, data.eval_views
    plain = bake(model.scene, [view.camera for view in train], replace(bake_options, format="uint8"))
    tuned = tune_atlas(plain, train, background, tune_options)
    cost = tuned.statistics.finetune
    rows = []
    for form in formats:
        options = replace(bake_options, format=form)  # type: ignore[arg-type]
        both = [replace(each, options=options).with_texels(each.texels).encoded() for each in (plain, tuned)]
        before, after = (quality(each, evaluation, background) for each in both)
        figures = [number(q[name], 2 if name == "psnr" else 4) for q in (before, after) for name in METRICS]
        texels = int(plain.packing.tiles[:, 3].astype("int64") @ plain.packing.tiles[:, 4].astype("int64"))
        gain = difference(after["psnr"] - before["psnr"], 2)
        scene = run.resolve().parents[2].name
        seconds = number(cost.cpu_seconds, 0)
        rows.append([scene, form, number(texels, 0), *figures, gain, str(cost.best_step), seconds])
        say(" ".join(rows[-1]))
    return rows


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--runs", nargs="+", type=Path, required=True, help="config.yml of trained runs")
    parser.add_argument("--formats", nargs="+", default=["fp16", "bc7"], help="atlas formats (%(default)s)")
    parser.add_argument("--finetune-steps", type=int, default=TuneOptions.steps, help="(%(default)s)")
    parser.add_argument(
        "--bake", nargs="*", default=[], metavar="NAME=VALUE", help="options of the bake: r_max=16, say"
    )
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    stated = {name: yaml.safe_load(value) for name, value in (each.split("=", 1) for each in options.bake)}
    bake_options = build(BakeOptions, stated, "--bake", "")
    rows = []
    for run in options.runs:
        rows += measure(run, options.formats, bake_options, TuneOptions(steps=options.finetune_steps))
    publish(page("Fine-tuning the texels", table(HEADER, rows, (0, 1))), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
