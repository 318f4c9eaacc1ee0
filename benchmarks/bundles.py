#!/usr/bin/env python
"""What bundles of captures cost and show: version 2, compact as it is, and compact at given sizes.

A capture is trained with texels and a seed, baked and reduced once; from there every form is stored as `ns-export
bitymi-atlas` stores it with its defaults, written, opened, and compared with the held-out photographs. What is done is
kept in the work folder and not done again: CAPTURE-SEED.scene.pt, CAPTURE-SEED.reduced.pt (which `rate.py --keep`
reads), and a line of bundles.jsonl for each form.

Forms: bc7 (version 2), compact (version 3), a number N (version 3 by --target-mb N), price=P (version 3 where a bit is
worth P, squared error in 8-bit steps, as in rate.py).

  their bytes   of surfels.ply or surfels.bin; each: per surfel
  view colours  of these
  texels        bytes of atlas.ktx2 or texels.bin
  all           of bundle.json and all files that it lists; nothing else is downloaded. There is no preview
  PSNR, ...     means over the held-out views
  frame         CPU ms of a thread for a held-out view: mean over the views of the least of some repeats
  load          CPU ms, least of three
  memory        MB: peak of a process while it loads, above what it had before, and what it keeps
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")

import torch
from common import CommandFailed, cpu_milliseconds, number, page, publish, say, table
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from plain_capture import Capture, load_capture, load_split_capture

from bitymi_ns.bake import BakeOptions, Learning, TuneOptions, baked_and_reduced
from bitymi_ns.bake.compact import Coder, Compact, chosen, kept_at
from bitymi_ns.bake.learn import stored
from bitymi_ns.bundle import Bundle, export, read_bundle
from bitymi_ns.bundle.manifest import Manifest
from bitymi_ns.bundle.read import download_bytes
from bitymi_ns.measure.bench.machine import commit
from bitymi_ns.measure.report.pareto import front
from bitymi_ns.plugin.export.command import STEPS_AFTER_LEARNING
from bitymi_ns.plugin.export.compact_options import CompactOptions
from bitymi_ns.plugin.run.metrics import image_metrics
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.domain import build_scene
from bitymi_ns.train.fit import fit
from bitymi_ns.train.init import first_surfels_for
from bitymi_ns.train.views import View, eval_background

COLUMNS = (
    "scene", "seed", "form", "surfels", "their bytes", "each", "view colours", "texels", "all", "PSNR", "SSIM", "FLIP",
    "frame, ms", "load, ms", "memory, MB",
)  # fmt: skip
POINTS = "hull_pc.ply"
FORMS = {"ply": "PLY", "compressed.ply": "compressed PLY", "sog": "SOG", "spz": "SPZ"}
MARKS = (
    ("s", "tab:gray"),
    ("o", "tab:blue"),
    ("v", "tab:brown"),
    ("P", "tab:olive"),
    ("D", "tab:red"),
    ("^", "tab:green"),
)
METRICS = ("psnr", "ssim", "flip")
OF_VIEW_COLORS = ("view_base", "view_count", "term_shape", "term_color")


class Results:
    """Lines of a file, by what they are of."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = path.read_text("utf8").splitlines() if path.is_file() else []
        self.lines: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def find(self, **key: Any) -> dict[str, Any] | None:
        """The last line of a key."""
        return next((line for line in reversed(self.lines) if key.items() <= line.items()), None)

    def add(self, line: dict[str, Any]) -> None:
        """Keep a line."""
        self.lines.append(line)
        with self.path.open("a", encoding="utf8") as file:
            file.write(json.dumps(line) + "\n")


def load(folder: Path, downscale: int) -> Capture:
    """A capture with a transforms.json, or of the Blender data set's kind with the points `POINTS`."""
    if (folder / "transforms_train.json").is_file():
        return load_split_capture(folder, POINTS, downscale)
    return load_capture(folder, downscale=downscale)


def trained(capture: Capture, seed: int, steps: int) -> dict[str, Any]:
    """A scene with texels, the background that it is judged over, held-out dB and CPU seconds."""
    bounded = capture.train[0].image.shape[-1] == 4
    config = TrainConfig(seed=seed)
    cameras = [view.camera for view in capture.train]
    pixels = sum(camera.width * camera.height for camera in cameras)
    config.first_surfels = first_surfels_for(steps, pixels / len(cameras))
    centers, options = torch.stack([camera.center for camera in cameras]), SceneConfig(texture="texels")
    scene, _ = build_scene(capture.points, capture.colours, centers, options, config, bounded, pixels)
    log = fit(scene, capture.train, capture.held_out, config, steps)
    background = eval_background(config, "cpu")
    last = log.entries[-1]
    return {
        "scene": scene,
        "background": torch.zeros(3) if background is None else background,
        "steps": steps,
        "psnr": last.psnr,
        "cpu_seconds": last.cpu_seconds,
    }


def reduced_bake(capture: Capture, run: dict[str, Any]) -> dict[str, Any]:
    """What `rate.py` keeps of a run."""
    cameras = [view.camera for view in capture.train]
    baked = baked_and_reduced(run["scene"], cameras, capture.train, run["background"], BakeOptions(), Learning())
    kept = {"baked": baked, "views": capture.train, "held": capture.held_out, "background": run["background"]}
    return {**kept, "learned": True}


def kept(path: Path, make: Any) -> Any:
    """What a file holds, or what is made and then kept there."""
    if path.is_file():
        return torch.load(path, weights_only=False)
    say(f"making {path.name}")
    made = make()
    unfinished = path.with_suffix(".unfinished")
    torch.save(made, unfinished)
    unfinished.rename(path)
    return made


class Reduced:
    """A reduced bake and what is measured of it once for all compact forms."""

    def __init__(self, found: dict[str, Any]) -> None:
        self.found, self._coder = found, None

    def form(self, name: str, folder: Path) -> float:
        """Writes a bundle; CPU seconds."""
        start, found = time.process_time(), self.found
        views, background = found["views"], found["background"]
        baked, coding = found["baked"], None
        baked = replace(baked, options=replace(baked.options, format="bc7" if name == "bc7" else "uint8"))
        if name != "bc7":
            coder = self._coder = self._coder or Coder(baked, views, background, Compact())
            if name.startswith("price="):
                baked, coding = kept_at(coder, coder.at(float(name[6:]) / 255**2))
            else:
                plain = name == "compact"
                baked, coding = chosen(
                    coder, Compact() if plain else CompactOptions(target_mb=float(name)).compact_of(0)
                )
        tune = TuneOptions.of_learned(STEPS_AFTER_LEARNING)
        made = stored(baked, [view.camera for view in views], views, background, tune, coding)
        export(made, folder, background=background.tolist(), overwrite=True)
        return time.process_time() - start


def sizes(folder: Path, info: Manifest) -> dict[str, int]:
    """Bytes of a bundle's parts."""
    if info.surfels.columns is not None:
        columns = (column for column in info.surfels.columns if column.name in OF_VIEW_COLORS)
        colors = sum(size for column in columns for planes in column.planes for size in planes)
    else:
        assert info.statistics.view_color is not None and info.statistics.view_color.bytes is not None
        colors = info.statistics.view_color.bytes.after
    texels = 0 if info.atlas is None else info.files[info.atlas.file].bytes
    surfels = info.files[info.surfels.file].bytes
    return {"surfels": surfels, "view_colors": colors, "texels": texels, "all": download_bytes(folder, info)}


@torch.no_grad()
def shown(bundle: Bundle, views: list[View], background: torch.Tensor, repeats: int) -> dict[str, float]:
    """Means over views."""
    rows, frames = [], []
    for view in views:
        draw = partial(bundle.scene.render, view.camera, background=background)
        picture, milliseconds = cpu_milliseconds(draw, repeats)
        rows.append(image_metrics(picture.rgb, view.target(background, "cpu"), view.mask))
        frames.append(milliseconds)
    return {**{name: fmean(row[name] for row in rows) for name in METRICS}, "frame_ms": fmean(frames)}


def opened(folder: Path) -> dict[str, float]:
    """Milliseconds and memory of loading a bundle, in a process of its own."""
    command = [sys.executable, str(Path(__file__).with_name("open_bundle.py")), str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise CommandFailed(f"{' '.join(command)} ended with exit status {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def measured(name: str, reduced: Reduced, folder: Path, repeats: int) -> dict[str, Any]:
    """A form of a bake: a line of bundles.jsonl, but for its key."""
    seconds = reduced.form(name, folder)
    bundle, found = read_bundle(folder), reduced.found
    line: dict[str, Any] = {"count": len(bundle), "bake_seconds": seconds, **sizes(folder, bundle.info)}
    rounding = bundle.info.statistics.rounding
    if bundle.info.atlas is not None and rounding is not None:
        line |= {"texel_step": bundle.info.atlas.step, "mse": rounding.mse}
    line |= shown(bundle, found["held"], found["background"], repeats)
    return {**line, **opened(folder), "commit": commit()}


def rows(results: Results, scenes: list[str], seeds: list[int], forms: list[str]) -> list[list[str]]:
    """Lines of the table."""
    found = []
    for scene in scenes:
        for seed in seeds:
            for form in forms:
                line = results.find(scene=scene, seed=seed, form=form)
                if line is None:
                    continue
                label = f"{form} MB" if form[0].isdigit() else form
                whole = [number(line[key], 0) for key in ("count", "surfels")]
                whole.append(number(line["surfels"] / line["count"], 1))
                whole += [number(line[key], 0) for key in ("view_colors", "texels", "all")]
                quality = [number(line["psnr"], 3), number(line["ssim"], 4), number(line["flip"], 4)]
                cost = [number(line[key], 0) for key in ("frame_ms", "load_ms")]
                cost.append(f"{line['peak_mb']:.0f}, {line['kept_mb']:.0f}")
                found.append([scene, str(seed), label, *whole, *quality, *cost])
    return found


def plot(ours: list[dict[str, Any]], theirs: list[dict[str, Any]], scene: str, path: Path) -> None:
    """Held-out PSNR against the bytes of a download: every point, and a line through those that none other beats.

    Args:
        ours: lines of bundles.jsonl.
        theirs: lines of gaussians.jsonl (`gaussian_files.py`).
    """
    series: dict[str, list[tuple[float, float]]] = {}
    for line in ours:
        name = "bitymi, version 2" if line["form"] == "bc7" else "bitymi, version 3"
        series.setdefault(name, []).append((line["all"] / 1e6, line["psnr"]))
    for line in theirs:
        series.setdefault(f"OpenSplat, {FORMS[line['form']]}", []).append((line["bytes"] / 1e6, line["psnr"]))
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.add_subplot()
    for (name, points), (mark, color) in zip(series.items(), MARKS, strict=False):
        axes.plot(*zip(*points, strict=True), mark, color=color, ms=4.5)
        best = front(points, up=True)
        axes.plot(*zip(*best, strict=True), mark + "-", color=color, ms=4.5, linewidth=1.2, label=name)
    ticks = [n for n in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if n >= 0.7 * min(x for p in series.values() for x, _ in p)]
    axes.set(xscale="log", xlabel="download, MB", ylabel="PSNR of held-out views, dB", title=scene)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_figure(str(path), dpi=120)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--data", nargs="+", type=Path, help="folders of captures")
    parser.add_argument("--work", type=Path, default=Path("outputs/bundles"), help="what is kept (%(default)s)")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="(%(default)s)")
    parser.add_argument("--steps", type=int, default=1200, help="of training (%(default)s)")
    parser.add_argument("--downscale", type=int, default=1, help="of the photographs (%(default)s)")
    parser.add_argument("--forms", nargs="*", default=["bc7", "compact", "1.5", "0.75"], help="(%(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="of frames (%(default)s)")
    parser.add_argument("--plot", type=Path, help="picture to write, of the first capture and seed")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if not options.data:
        parser.error("give folders of captures (--data)")
    options.work.mkdir(parents=True, exist_ok=True)
    results = Results(options.work / "bundles.jsonl")
    for folder in options.data:
        capture = load(folder.expanduser(), options.downscale)
        for seed in options.seeds:
            name = f"{folder.name}-{seed}"
            run = partial(trained, capture, seed, options.steps)
            scene = kept(options.work / f"{name}.scene.pt", run)
            missing = [f for f in options.forms if results.find(scene=folder.name, seed=seed, form=f) is None]
            if not missing:
                continue
            found = kept(options.work / f"{name}.reduced.pt", partial(reduced_bake, capture, scene))
            reduced = Reduced(found)
            for form in missing:
                say(f"{name}: {form}")
                key = {"scene": folder.name, "seed": seed, "form": form, "steps": scene["steps"]}
                line = measured(form, reduced, options.work / f"{name}.{form.replace('=', '-')}", options.repeats)
                results.add({**key, "trained_psnr": scene["psnr"], "train_cpu_s": scene["cpu_seconds"], **line})
    scenes = [folder.name for folder in options.data]
    if options.plot is not None:
        ours = [line for line in results.lines if (line["scene"], line["seed"]) == (scenes[0], options.seeds[0])]
        theirs = [line for line in Results(options.work / "gaussians.jsonl").lines if line["scene"] == scenes[0]]
        plot(ours, theirs, scenes[0], options.plot)
    body = table(COLUMNS, rows(results, scenes, options.seeds, options.forms), (0, 1, 2))
    commits = [line["commit"] for line in results.lines if line["scene"] in scenes]
    publish(page("Bundles of captures", body, (), commits), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
