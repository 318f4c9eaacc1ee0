#!/usr/bin/env python
"""Compare training options in long and short runs, with the core packages only (without nerfstudio): no default is
chosen from short runs alone.

    python benchmarks/long.py DATA... --rows bitymi "bitymi train.texels.mean_rates=0.2" --runs 10000/4 1500/2 300/1

A run is STEPS/REDUCTION: number of steps, and integer factor by which photographs are downscaled. A long one takes 25
to 60 minutes on one CPU core, or one to two on a GPU (--device cuda). Several commands with the same --work share the
runs. Rounding alone moves PSNR by 0.1 dB: give --seeds."""

import collections
import contextlib
import csv
import functools
import itertools
import shlex
import statistics
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import torch
import yaml
from harness import Arguments, image_quality, means, publish, say
from matplotlib.lines import Line2D
from scenes import SplitCapture, load_capture
from torch import Tensor

from bitymi_ns import bake_scene
from bitymi_ns.bundle import read_bundle
from bitymi_ns.locks import Busy, Lock
from bitymi_ns.measure.bench.cells import FILE, Cells, identity, provenance, without_nan
from bitymi_ns.measure.figure import COLORS, Panel, png
from bitymi_ns.measure.machine import commit
from bitymi_ns.measure.report.plots import METRICS, costs, pareto_panel
from bitymi_ns.measure.report.records import Evaluation, over_seeds
from bitymi_ns.measure.report.tables import markdown_tables, quality_tables
from bitymi_ns.plugin.run.metrics import LPIPS, lpips_metrics
from bitymi_ns.ranges import spread
from bitymi_ns.scene import Scene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.scene import RenderOutput
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.exposure import corrected
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.preset import Loader, Preset, load_preset
from bitymi_ns.train.views import View, eval_background
from bitymi_ns.trust import finite_numbers

RUNS = ("10000/4", "1500/2", "300/1")


@dataclass(frozen=True)
class LongRun:
    """One training run."""

    data: str
    row: str
    steps: int
    reduction: int
    seed: int
    photographs: int
    bake: bool
    align: bool
    device: str
    megabytes: tuple[float, ...] = ()  # sizes of further bundles
    keep: Path | None = None  # folder to keep the bundles in

    @property
    def key(self) -> dict[str, Any]:
        names = ("steps", "reduction", "seed", "photographs", "bake", "align", "megabytes")
        settings = {name: getattr(self, name) for name in names if name != "megabytes" or self.megabytes}
        settings |= {"device": device_name(self.device)}
        return {**settings, "data": Path(self.data).resolve().name, "settings": self.row, "commit": commit()}


def device_name(device: str) -> str:
    """Return the GPU's model, or cpu."""
    return torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else "cpu"


def preset_of(row: str) -> Preset:
    """Load the preset of a row and apply its settings. Raises ValueError: an option does not exist."""
    name, *settings = shlex.split(row)
    preset = load_preset(name)
    for setting in settings:
        path, _, text = setting.partition("=")
        *parents, leaf = path.split(".")
        owner: Any = preset
        for parent in parents:
            owner = getattr(owner, parent)
        if leaf not in vars(owner):
            raise ValueError(f"row '{row}': there is no option {path}")
        value = yaml.load(text, Loader)
        if isinstance(value, bool) and isinstance(getattr(owner, leaf), str):
            value = text  # YAML reads on and off as booleans
        setattr(owner, leaf, tuple(value) if isinstance(value, list) else value)
    return preset


def quality(draw: Callable[[Camera], Any], views: Sequence[View], background: Tensor | None) -> dict[str, float]:
    """Compare renders with photographs: means over views on the device of `draw`."""
    rows = []
    for view in views:
        with torch.no_grad():
            drawn = draw(view.camera)
        rgb, target = view.shown(drawn.rgb, drawn.alpha, background), view.target(background, drawn.rgb.device)
        rows.append(image_quality(rgb, target) | lpips_metrics(rgb.clamp(0.0, 1.0), target, tuple(LPIPS)))
    return means(rows)


def peak_megabytes(device: torch.device) -> float:
    """Read the most memory in MB since the last `forget_peak`: a GPU's tensors, or the whole process on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    return next(
        int(line.split()[1]) * 1.024e-3
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("VmHWM")
    )


def forget_peak(device: torch.device) -> None:
    """Begin a new peak of `peak_megabytes`."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    else:
        Path("/proc/self/clear_refs").write_text("5")


load = functools.lru_cache(maxsize=1)(load_capture)


def cut(capture: SplitCapture, photographs: int) -> SplitCapture:
    """Keep at most `photographs` training photographs (0 = all), evenly spaced; held-out ones do not change."""
    kept = spread(len(capture.train), photographs or len(capture.train))
    return replace(capture, train=[capture.train[i] for i in kept])


def measure(run: LongRun) -> dict[str, Any]:
    """Train, evaluate and, if requested, bake a run."""
    preset = preset_of(run.row)
    preset.train.seed = run.seed
    capture, device = cut(load(Path(run.data), run.reduction), run.photographs), torch.device(run.device)
    if capture.white:
        preset.train.alpha_color = "white"
    forget_peak(device)
    torch.manual_seed(run.seed)
    scene = scene_for_views(capture.train, capture.points, capture.colours, preset.scene, preset.train, run.steps).to(
        device
    )
    trainer = Trainer(scene, capture.train, preset.train, run.steps)
    clock = trainer.training.clock
    shown = {run.steps * i // 20 for i in range(1, 20)}
    while trainer.step < run.steps:
        trainer.advance()
        if trainer.step in shown:
            say(f"step {trainer.step:,}: loss {trainer.loss:.4f}, {len(scene):,} surfels, {clock.cpu_seconds:.0f} s")
    peak = peak_megabytes(device)
    background = eval_background(preset.train, device)
    poses, exposure = trainer.training.poses, trainer.training.exposure
    held_out = [view._replace(correction=exposure.at(view.file)) for view in capture.held_out]
    fragments = []

    def draw(camera: Camera) -> RenderOutput:
        output = scene.render(camera.to(device), background, "frozen")
        fragments.append(len(output.fragments) / (camera.width * camera.height))
        return output

    found = quality(draw, held_out, background) | {"fragments": statistics.fmean(fragments)}
    aligned = run.align or poses.refined
    if aligned or exposure.table is not None:
        judged = evaluate(scene, capture.held_out, preset.train, poses if aligned else None, exposure)
        found |= {name: getattr(judged, name) for name in ("carried_psnr", "refined_psnr", "mean_exposure_psnr")}
    found |= {"surfels": len(scene), "rollbacks": trainer.training.guard.rollbacks}
    camera = capture.train[0].camera
    found |= {"cpu_seconds": clock.cpu_seconds, "seconds": clock.seconds, "peak_megabytes": peak}
    found |= {"width": camera.width, "height": camera.height}
    if run.bake:
        say(f"PSNR {found['psnr']:.2f} dB, {len(scene):,} surfels; baking")
        views = [view._replace(camera=poses.of(i, view.camera)) for i, view in enumerate(capture.train)]
        views = corrected(views, exposure.state_dict(), [view.file for view in views])
        default, *others = (bundle(run, scene, views, held_out, background, size) for size in (None, *run.megabytes))
        found |= {"bake_seconds": default["seconds"], "kilobytes": default["kilobytes"]}
        found |= {f"baked_{name}": default[name] for name in ("psnr", "ssim", "lpips")}
        found["curve"] = sorted([default, *others], key=lambda point: point["kilobytes"])
    return found


def bundle(
    run: LongRun,
    scene: Scene,
    views: Sequence[View],
    held_out: Sequence[View],
    background: Tensor | None,
    megabytes: float | None,
) -> dict[str, float]:
    """Bake a bundle and compare it with the held-out photographs."""
    name = "-".join((Path(run.data).stem, *shlex.split(run.row), f"{run.steps}-{run.seed}"))
    device = torch.device(run.device)
    with tempfile.TemporaryDirectory() as folder:
        path = (run.keep or Path(folder)) / (name if megabytes is None else f"{name}-{megabytes:g}MB")
        start = time.perf_counter()
        bake_scene(scene, views, path, background=background, overwrite=True, target_mb=megabytes)
        found = {"seconds": time.perf_counter() - start}
        found["kilobytes"] = sum(file.stat().st_size for file in path.iterdir()) / 1e3
        baked = read_bundle(path).scene.to(device)
    return found | quality(lambda camera: baked.render(camera.to(device), background), held_out, background)


def evaluations(runs: Sequence[LongRun], cells: Cells) -> list[Evaluation]:
    """List the figures of finished runs and of their bundles as `bitymi report` takes them; a capture with a length and
    a size is a scene."""
    rows = []
    for run in runs:
        if (cell := cells.get(run.key)) is None:
            continue
        value = finite_numbers(cell["value"])
        title = f"{Path(run.data).resolve().name}, {run.steps:,} steps, {value['width']:g} x {value['height']:g}"
        value |= {"fragments_per_pixel": value["fragments"], "train_seconds": value["seconds"]}
        value |= {"train_cpu_seconds": value["cpu_seconds"], "train_peak_bytes": 1e6 * value["peak_megabytes"]}
        seeds = {"run": f"{run.row} {run.seed}", "series": run.row, "seed": run.seed}
        rows.append(Evaluation(title, run.row, False, run.row, value, "", Path(run.data), group=run.row, **seeds))
        curve = cell["value"].get("curve", [])
        for i, point in enumerate(curve, 1):
            label = f"{run.row}, bundle{f' {i}' if len(curve) > 1 else ''}"
            figures = point | {"bundle_bytes": 1e3 * point["kilobytes"]}
            rows.append(Evaluation(title, run.row, True, label, figures, "", Path(run.data), group=label, **seeds))
    return rows


PUBLISHED = Path(__file__).with_name("published.csv")
"""Figures per scene that authors publish in their repositories, or in the survey 3dgs.zip, of their own files and
pictures."""


def draw_curves(rows: list[Evaluation]) -> bytes:
    """Plot PSNR and LPIPS of bundles against their bytes, and what others publish of the same scenes; return a PNG
    file."""
    rows, scenes = [row for row in rows if row.baked], dict.fromkeys(row.scene for row in rows)
    with open(PUBLISHED, newline="", encoding="utf8") as file:
        for row, scene in itertools.product(list(csv.DictReader(file)), scenes):
            if scene.startswith(f"{row['scene']},"):
                method = f"{row['program'].split()[0]}, published, {row['pictures']}"
                figures = {"psnr": float(row["psnr"]), "bundle_bytes": float(row["bytes"])}
                rows.append(Evaluation(scene, method, True, method, figures, "", Path()))
    colors = {name: COLORS[i % len(COLORS)] for i, name in enumerate(dict.fromkeys(row.method for row in rows))}
    size, panels = costs(rows)[-1], []
    for scene, key in itertools.product(scenes, ("psnr", "lpips")):
        shown = [row for row in rows if row.scene == scene and key in row.results]
        markers = collections.defaultdict(lambda: "o")
        draw = functools.partial(pareto_panel, rows=shown, key=key, cost=size, colors=colors, markers=markers)
        panels.append(Panel(draw, scene, size.label, METRICS[key][0]))
    return png(panels, [Line2D([], [], color=color, label=name) for name, color in colors.items()], most=2)


def main() -> None:
    arguments = read_arguments()
    torch.set_num_threads(1)
    baked = arguments.bake or arguments.keep is not None or bool(arguments.megabytes) or arguments.plot is not None
    rest = (baked, arguments.align, arguments.device, tuple(arguments.megabytes), arguments.keep)
    runs = [
        LongRun(str(data), row, *(int(x) for x in run.split("/")), seed, arguments.photographs, *rest)
        for data, run, row, seed in itertools.product(arguments.data, arguments.runs, arguments.rows, arguments.seeds)
    ]
    for row in arguments.rows:
        preset_of(row)
    arguments.work.mkdir(parents=True, exist_ok=True)
    cells = Cells(arguments.work / FILE)
    for i, run in enumerate(runs):
        with contextlib.suppress(Busy), Lock(arguments.work / f"{crc32(identity(run.key).encode()):08x}.lock"):
            cells.refresh()
            if cells.get(run.key) is not None:
                continue
            say(f"{i + 1} of {len(runs)}: {run}")
            start = time.perf_counter()
            value = measure(run)
            cells.add(run.key, without_nan(value), provenance(sys.argv, time.perf_counter() - start))
            say(", ".join(f"{name} {figure:.4g}" for name, figure in finite_numbers(value).items()))
    cells.refresh()
    rows = evaluations(runs, cells)
    tables = markdown_tables(quality_tables(over_seeds(rows), training=True))
    publish("Long and short runs", "\n\n".join(tables), (), arguments.output)
    if arguments.plot is not None:
        arguments.plot.write_bytes(draw_curves(rows))


def read_arguments() -> Namespace:
    parser = Arguments(__doc__)
    parser.add_argument("data", nargs="+", type=Path, help="folders with a transforms.json, or such files")
    parser.add_argument("--rows", nargs="+", default=["bitymi"], help="a method each, and its settings: PATH=VALUE ...")
    parser.add_argument("--runs", nargs="+", default=list(RUNS), help="STEPS/REDUCTION each")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--photographs", type=int, default=0, help="train on so many photographs only; 0 = all")
    parser.add_argument("--bake", action="store_true", help="also bake: bytes, and quality of the bundle")
    parser.add_argument("--keep", type=Path, help="bake, and keep the bundles in this folder")
    parser.add_argument("--megabytes", nargs="+", type=float, default=[], help="bake bundles of these sizes, too")
    parser.add_argument("--plot", type=Path, help="plot quality against the sizes of the bundles, a PNG file")
    parser.add_argument("--align", action="store_true", help="align held-out poses of rows without refinement, too")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (%(default)s)")
    parser.add_argument("--work", type=Path, default=Path("outputs/long"), help="folder of the finished runs")
    parser.add_output()
    return parser.parse_args()


if __name__ == "__main__":
    main()
