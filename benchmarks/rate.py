#!/usr/bin/env python
"""Measure the rate-distortion curve of a compact bundle: held-out PSNR against bytes, as a table and a plot.

A run is baked, polished where its texels were not trained, and reduced once, as `ns-export bitymi-atlas --format
compact` does; `--keep` stores that in a file, from which the command continues the next time. For every lambda:
  lambda      squared error, in 8-bit steps, summed over pixels, channels and training views, that one bit may cost
  surfels     bytes of surfels.bin; per surfel
  texels      bytes of texels.bin
  MB          of both
  training    dB of eight training views; held-out: dB of the held-out views; before the texels are tuned
  tuned       dB of the held-out views after it (--tune)
"""

import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")

import torch
from common import arguments_of, number, page, publish, say, table
from harness import quality
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bitymi_ns.bake import Baked, BakeOptions, Learning, PolishOptions, TuneOptions, baked_and_reduced, tune_atlas
from bitymi_ns.bake.compact import Coder, Compact
from bitymi_ns.bake.learn import STEPS_AFTER_LEARNING
from bitymi_ns.plugin.data.cameras import to_cameras
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.exposure import corrected
from bitymi_ns.train.views import View

COLUMNS = ("lambda", "surfels", "per surfel", "terms", "texels", "MB", "training", "held-out", "tuned")


def polished(load_config: Path, steps: int) -> dict[str, Any]:
    """The reduced bake of a run, its training views, its held-out views, and the background."""
    _, pipeline = load_trained(load_config)
    model, data = pipeline.model, pipeline.datamanager
    views = to_cameras(data.train_dataset.cameras, "cpu")
    photographs = list(corrected(data.train_views, model.resume_state.get("exposure")))
    background, trained = model.background.cpu(), isinstance(model.scene.field, TexelField)
    learning = Learning(None if trained else PolishOptions(steps=steps), train=model.train_config)
    baked = baked_and_reduced(model.scene, views, photographs, background, BakeOptions(), learning)
    found = {"baked": baked, "views": photographs, "held": list(data.eval_views), "background": background}
    return {**found, "trained": trained}


def held_out(scene: BakedScene, views: list[View], background: torch.Tensor) -> float:
    """Mean dB."""
    cpu = torch.device("cpu")
    return quality(lambda camera: scene.render(camera, background=background).rgb, views, cpu, background)[0]


def plot(points: list[tuple[float, float]], name: str, path: Path) -> None:
    """Held-out PSNR against bytes."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(*zip(*sorted(points), strict=True), marker="o")
    axes.set(xscale="log", xlabel="surfels and texels, MB", ylabel="held-out PSNR, dB", title=name)
    axes.grid(True, which="both", alpha=0.3)
    ticks = sorted({round(megabytes, 2) for megabytes, _ in points})
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    FigureCanvasAgg(figure).print_figure(str(path), dpi=120)


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("--load-config", type=Path, help="config.yml of a run")
    parser.add_argument("--keep", type=Path, help="file of the polished bake; read where it is there, else written")
    parser.add_argument("--lambdas", nargs="+", type=float, default=[2.0, 6.0, 18.0, 54.0], help="(%(default)s)")
    parser.add_argument("--polish-steps", type=int, default=PolishOptions.steps, help="(%(default)s)")
    parser.add_argument("--tune", action="store_true", help="tune the texels, too; a minute for each lambda")
    parser.add_argument("--plot", type=Path, default=Path("rate.png"), help="picture to write (%(default)s)")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    if options.keep is not None and options.keep.is_file():
        found = torch.load(options.keep, weights_only=False)
    elif options.load_config is not None:
        found = polished(options.load_config, options.polish_steps)
        if options.keep is not None:
            torch.save(found, options.keep)
    else:
        parser.error("give the config.yml of a run (--load-config), or the file of an earlier one (--keep)")
    baked: Baked = found["baked"]
    views, held, background = found["views"], found["held"], found["background"]
    say(f"{len(baked.rows):,} surfels, {baked.packing.texels:,} texels")
    whole = held_out(baked.unquantised(), held, background)
    coder, rows, points = Coder(baked, views, background, Compact()), [], []
    for value in options.lambdas:
        coded = coder.at(value / 255**2)
        surfels = coded.baked.codes.surfels
        shown, tuned = held_out(coded.shown, held, background), None
        if options.tune:
            make = TuneOptions.of_learned if found["trained"] else TuneOptions
            steps = make(steps=STEPS_AFTER_LEARNING)
            tuned = held_out(
                tune_atlas(coded.baked, views, background, steps, coding=coded.coding).stored(), held, background
            )
        size, terms = surfels.nbytes(), len(surfels.codes["term_color"])
        row = [number(value), f"{size:,}", number(size / len(surfels), 1), f"{terms:,}", f"{coded.bytes - size:,}"]
        row += [number(coded.bytes / 1e6, 2), number(coded.psnr, 2), number(shown, 2)]
        rows.append([*row, "" if tuned is None else number(tuned, 2)])
        points.append((coded.bytes / 1e6, shown if tuned is None else tuned))
        say(" ".join(rows[-1]))
    name = options.load_config.parent.name if options.load_config is not None else options.keep.stem
    plot(points, f"{name}: {whole:.2f} dB before it is made compact", options.plot)
    publish(page(f"Rate of {name}, {whole:.2f} dB before", table(COLUMNS, rows)), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
