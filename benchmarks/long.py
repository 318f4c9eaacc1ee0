#!/usr/bin/env python
"""Compare training options in long and short runs, without nerfstudio's commands.

    python benchmarks/long.py DATA... --rows bitymi "bitymi train.texels.mean_rates=0.2" --runs 10000/4 1500/2 300/1

A run is STEPS/REDUCTION: number of steps, and integer factor by which photographs are downscaled. A long one takes 25
to 60 minutes on one CPU core, or one to two on a GPU. Several commands with the same --work share the runs, which
`bitymi report WORK` plots. Rounding alone moves PSNR by 0.1 dB: give --seeds."""

import contextlib
import functools
import itertools
import shlex
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import torch
import tyro
import yaml
from scenes import load_capture
from torch import Tensor

from bitymi_ns import bake_scene
from bitymi_ns.bundle import read_bundle
from bitymi_ns.locks import Busy, Lock
from bitymi_ns.measure.bench.cells import FILE, Cells, identity, provenance
from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.machine import commit
from bitymi_ns.measure.markdown import page, publish
from bitymi_ns.measure.report.read import add_cells
from bitymi_ns.measure.report.records import Records, means, over_seeds
from bitymi_ns.measure.report.tables import quality_markdown
from bitymi_ns.plugin.run.metrics import image_metrics
from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.exposure import corrected
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.preset import Loader, Preset, load_preset
from bitymi_ns.train.views import View, eval_background
from bitymi_ns.trust import finite_numbers

Figures = dict[str, dict[str, Any]]
"""Values of a run's cells: `train`, `eval`, and `export NAME` and `eval NAME` of each bundle."""


@dataclass
class Options:
    data: tyro.conf.Positional[tuple[Path, ...]]  # Folders with a transforms.json, or such files.
    rows: tuple[str, ...] = ("bitymi",)  # A method each, and its settings: PATH=VALUE ...
    runs: tuple[str, ...] = ("10000/4", "1500/2", "300/1")  # STEPS/REDUCTION each.
    seeds: tuple[int, ...] = (0,)
    photographs: int = 0  # Train on so many photographs; 0 = all.
    bake: bool = False  # Also bake.
    keep: Path | None = None  # Bake, and keep the bundles in this folder.
    megabytes: tuple[float, ...] = ()  # Also bake bundles of these sizes.
    align: bool = False  # Also align held-out poses of rows without refinement.
    device: str = "cpu"  # cpu or cuda
    work: Path = Path("outputs/long")  # Folder of the finished runs.
    output: Path | None = None  # Also write the table to this Markdown file.


@dataclass(frozen=True)
class LongRun:
    """A training run."""

    data: Path
    row: str
    steps: int
    reduction: int
    seed: int
    options: Options

    def __str__(self) -> str:
        return f"{self.scene}, {self.row}, seed {self.seed}"

    @property
    def scene(self) -> str:
        """Name in tables."""
        return f"{self.data.resolve().name}, {self.steps:,} steps at 1/{self.reduction}"

    def key(self, cell: str = "eval") -> dict[str, Any]:
        """Build the key of one of the `Figures`."""
        kind, _, bundle = cell.partition(" ")
        key = {"cell": kind, "row": self.row, "scene": self.scene, "settings": self.row, "steps": self.steps}
        key |= {name: getattr(self.options, name) for name in ("photographs", "bake", "align", "megabytes")}
        device = self.options.device  # a GPU's model, or cpu
        device = "cpu" if device == "cpu" else torch.cuda.get_device_name(device)
        key |= {"seed": self.seed, "device": device, "commit": commit()}
        return key | ({"bundle": bundle} if bundle else {})


def preset_of(row: str) -> Preset:
    """Load the preset of a row with its settings. Raises ValueError: an option does not exist."""
    name, *settings = shlex.split(row)
    preset = load_preset(name)
    for setting in settings:
        path, _, text = setting.partition("=")
        *parents, leaf = path.split(".")
        owner: Any = functools.reduce(getattr, parents, preset)
        if leaf not in vars(owner):
            raise ValueError(f"row '{row}': there is no option {path}")
        value = yaml.load(text, Loader)
        if isinstance(value, bool) and isinstance(getattr(owner, leaf), str):
            value = text  # YAML reads on and off as booleans
        setattr(owner, leaf, tuple(value) if isinstance(value, list) else value)
    return preset


def quality(draw: Callable[[Camera], Any], views: Sequence[View], background: Tensor | None) -> dict[str, float]:
    """Compare renders with photographs: means over views."""
    rows = []
    for view in views:
        with torch.no_grad():
            drawn = draw(view.camera)
        shown = view.shown(drawn.rgb, drawn.alpha, background)
        rows.append(image_metrics(shown, view.target(background, shown.device), view.mask))
    return means(rows)


def peak_bytes(device: torch.device) -> float:
    """Read the peak memory since the last call: a GPU's tensors, or the whole process on a CPU."""
    if device.type == "cuda":
        most = torch.cuda.max_memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        return most
    lines = Path("/proc/self/status").read_text().splitlines()
    Path("/proc/self/clear_refs").write_text("5")
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


load = functools.lru_cache(maxsize=1)(load_capture)


def measure(run: LongRun) -> Figures:
    """Train, evaluate and, if requested, bake a run."""
    options, preset = run.options, preset_of(run.row)
    preset.train.seed = run.seed
    capture, device = load(run.data, run.reduction), torch.device(options.device)
    kept = spread(len(capture.train), options.photographs or len(capture.train))
    capture = replace(capture, train=[capture.train[i] for i in kept])  # held-out ones do not change
    if capture.white:
        preset.train.alpha_color = "white"
    peak_bytes(device)
    torch.manual_seed(run.seed)
    first = (capture.train, capture.points, capture.colours, preset.scene, preset.train, run.steps)
    scene = scene_for_views(*first).to(device)
    trainer = Trainer(scene, capture.train, preset.train, run.steps)
    training, clock = trainer.training, trainer.training.clock
    shown = {run.steps * i // 20 for i in range(1, 20)}
    while trainer.step < run.steps:
        trainer.advance()
        if trainer.step in shown:
            say(f"step {trainer.step:,}: loss {trainer.loss:.4f}, {len(scene):,} surfels, {clock.cpu_seconds:.0f} s")
    costs = {"seconds": clock.seconds, "cpu_seconds": clock.cpu_seconds, "peak_bytes": peak_bytes(device)}
    background = eval_background(preset.train, device)
    poses, exposure = training.poses, training.exposure
    held_out = [view._replace(correction=exposure.at(view.file)) for view in capture.held_out]
    say(f"{len(scene):,} surfels; evaluating")
    results = quality(lambda camera: scene.render(camera.to(device), background, "frozen"), held_out, background)
    aligned = poses if options.align or poses.refined else None
    judged = evaluate(scene, capture.held_out, preset.train, aligned, exposure)
    pixels = statistics.fmean(view.camera.width * view.camera.height for view in held_out)
    results |= {"fragments_per_pixel": judged.fragments / pixels, "surfels": len(scene)}
    results |= {name: getattr(judged, name) for name in ("carried_psnr", "refined_psnr", "mean_exposure_psnr")}
    figures: Figures = {"train": costs | {"steps": run.steps, "rollbacks": training.guard.rollbacks}}
    views = [view._replace(camera=poses.of(i, view.camera)) for i, view in enumerate(capture.train)]
    views = corrected(views, exposure.state_dict(), [view.file for view in views if view.file])
    name = "-".join((run.data.stem, *shlex.split(run.row), f"{run.steps}-{run.seed}"))
    for size in (None, *options.megabytes) if options.bake else ():
        form = "compact" if size is None else f"{size:g} MB"
        with tempfile.TemporaryDirectory() as folder:
            path = (options.keep or Path(folder)) / (name if size is None else f"{name}-{size:g}MB")
            start = time.perf_counter()
            bake_scene(scene, views, path, background=background, overwrite=True, target_mb=size)
            seconds = time.perf_counter() - start
            written = sum(file.stat().st_size for file in path.iterdir())
            baked = read_bundle(path).scene.to(device)
        drawn = quality(lambda camera, baked=baked: baked.render(camera.to(device), background), held_out, background)
        figures[f"export {form}"] = {"bytes": written, "seconds": seconds}
        figures[f"eval {form}"] = {"results": drawn | {"surfels": len(baked.surfels["means"])}}
    return figures | {"eval": {"results": results}}  # the last cell: the run is complete


def main(options: Options) -> None:
    torch.set_num_threads(1)
    options.bake |= options.keep is not None or bool(options.megabytes)
    runs = [
        LongRun(data, row, *map(int, run.split("/")), seed=seed, options=options)
        for data, run, row, seed in itertools.product(options.data, options.runs, options.rows, options.seeds)
    ]
    for row in options.rows:
        preset_of(row)  # raises before hours of training
    options.work.mkdir(parents=True, exist_ok=True)
    cells = Cells(options.work / FILE)
    for i, run in enumerate(runs):
        with contextlib.suppress(Busy), Lock(options.work / f"{crc32(identity(run.key()).encode()):08x}.lock"):
            cells.refresh()
            if cells.get(run.key()) is not None:
                continue
            say(f"{i + 1} of {len(runs)}: {run}")
            start = time.perf_counter()
            figures = measure(run)
            made = provenance(sys.argv, time.perf_counter() - start)
            for name, value in figures.items():
                cells.add(run.key(name), value, made)
            said = finite_numbers({**figures["train"], **figures["eval"]["results"]})
            say(", ".join(f"{name} {figure:.4g}" for name, figure in said.items()))
    cells.refresh()
    records, own = Records(), {identity(run.key(), "cell") for run in runs}
    finished = [cell for cell in cells.known.values() if identity(cell["key"], "cell", "bundle") in own]
    add_cells(finished, cells.path, records)
    publish(page("Long and short runs", quality_markdown(over_seeds(records.evaluations))), options.output)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
