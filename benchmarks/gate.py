#!/usr/bin/env python
"""Compare quality, bytes, memory and time of a fixed small job with the committed baseline, benchmarks/gate.json.

Rounding alone moves one seed's PSNR by up to 0.13 dB, so means over seeds and all photographs are compared. CPU seconds
are divided by those of a calibration run in between, so that a busy or slower machine gives the same figures."""

import itertools
import json
import math
import multiprocessing
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from scenes import SplitCapture, load_capture

from bitymi_ns.bake import BakeOptions, RefineOptions, TuneOptions, bake, export
from bitymi_ns.bundle import read_bundle
from bitymi_ns.files import write_file
from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.machine import processor
from bitymi_ns.measure.markdown import number, table
from bitymi_ns.measure.report.records import means
from bitymi_ns.plugin.run import lpips
from bitymi_ns.sample import generate
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import fit
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.losses import psnr

BASELINE = Path(__file__).with_suffix(".json")
THREADS = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
SETTINGS = {"steps": 320, "tuning": 20, "seeds": 4}  # steps of training and of texel tuning, number of seeds


@dataclass(frozen=True)
class Limit:
    """Tolerance of a figure against the baseline."""

    title: str
    better: str  # direction, "more" or "less"
    by: float  # largest allowed change for the worse
    relative: bool = True  # `by` is a share of the baseline
    digits: int = 0  # decimals to print
    timed: bool = False  # compared only on the baseline's processor


LIMITS = {
    "psnr_trained": Limit("PSNR trained, dB", "more", 0.05, relative=False, digits=3),
    "psnr_baked": Limit("PSNR baked, dB", "more", 0.05, relative=False, digits=3),
    "lpips_baked": Limit("LPIPS baked", "less", 0.03, digits=4),
    "bundle_bytes": Limit("bundle, bytes", "less", 0.03),
    "surfels": Limit("surfels", "less", 0.03),
    "fragments_per_pixel": Limit("fragments per pixel", "less", 0.03, digits=2),
    "peak_mb": Limit("peak memory, MB", "less", 0.10),
    "train": Limit("training, calibrations", "less", 0.15, digits=2, timed=True),
    "bake": Limit("bake and tuning, calibrations", "less", 0.15, digits=2, timed=True),
    "frame": Limit("a baked frame, calibrations", "less", 0.15, digits=4, timed=True),
}
ELSEWHERE = 2.0  # factor of the limits on another processor model than the baseline's
Figures = dict[str, float]


class Calibration:
    """Fixed mixture of the operations of training, run repeatedly while a part is timed, so that a slow machine slows
    both. None dominates: the gather alone varies twice as much as training when other programs share the caches."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self._matrix = torch.randn(640, 640, generator=generator)
        self._keys = torch.rand(400_000, generator=generator)
        self._table = torch.rand(1 << 21, 4, generator=generator)
        self._rows = torch.randint(1 << 21, (250_000,), generator=generator)
        self._chain = torch.rand(1 << 14, generator=generator)
        self.seconds: list[float] = []
        self.run()
        self.seconds.clear()  # warm-up

    def run(self) -> None:
        start = time.process_time()
        x = self._matrix
        for _ in range(4):
            x = (x @ self._matrix).tanh()
        self._keys.argsort()
        self._table[self._rows].sum()
        y = self._chain
        for _ in range(200):
            y = (y * y + 0.5).sqrt().exp().log()
        sum(i * i % 7 for i in range(200_000))
        self.seconds.append(time.process_time() - start)

    def every(self, n: int) -> Callable[..., None]:
        """Create a callback that runs the workload at every n-th call."""
        calls = itertools.count(1)
        return lambda *_: self.run() if next(calls) % n == 0 else None

    def timed(self, work: Callable[[], Any]) -> tuple[Any, float]:
        """Return the result of `work`, and its CPU time in medians of the calibration runs during or after it."""
        self.seconds.clear()
        start = time.process_time()
        result = work()
        seconds = time.process_time() - start - sum(self.seconds)
        if not self.seconds:
            self.run()
        return result, seconds / statistics.median(self.seconds)


def run_seed(capture: SplitCapture, seed: int, calibration: Calibration) -> Figures:
    """Measure the figures of one seed."""
    config, background = TrainConfig(seed=seed), torch.zeros(3)
    views = [*capture.train, *capture.held_out]
    cameras = [view.camera for view in capture.train]
    scene = scene_for_views(capture.train, capture.points, capture.colours, SceneConfig(texture="texels"), config)
    train = partial(fit, scene, capture.train, [], config, SETTINGS["steps"], callback=calibration.every(10))
    _, training = calibration.timed(train)
    trained = evaluate(scene, views, config)
    refine = RefineOptions(tune=TuneOptions.of_learned(SETTINGS["tuning"]), train=config)
    to = (BakeOptions(format="bc7"), refine, calibration.every(10))
    baked, baking = calibration.timed(partial(bake, scene, cameras, capture.train, background, *to))
    with tempfile.TemporaryDirectory() as folder:
        bundle = Path(folder) / "bundle"
        export(baked, bundle)
        size = sum(path.stat().st_size for path in bundle.iterdir())
        drawn = read_bundle(bundle).scene
    quality, distances, units = [], [], []
    for view in views:
        image, unit = calibration.timed(partial(drawn.render, view.camera, background))
        units.append(unit)
        pair = image.rgb.clamp(0.0, 1.0), view.target(background, "cpu")
        quality.append(psnr(*pair))
        with suppress(lpips.LpipsUnavailable):  # reported by `main`
            distances.append(lpips.lpips(*pair, "alex"))
    return {
        "psnr_trained": trained.psnr,
        "psnr_baked": statistics.fmean(quality),
        "lpips_baked": statistics.fmean(distances or [math.nan]),
        "bundle_bytes": size,
        "surfels": len(scene),
        "fragments_per_pixel": trained.fragments / (cameras[0].width * cameras[0].height),
        "train": training,
        "bake": baking,
        "frame": statistics.median(units),
    }


def run_job(data: Path) -> Figures:
    """Measure the figures in this process: means over the seeds (minima of times), and peak memory."""
    torch.set_num_threads(int(THREADS["OMP_NUM_THREADS"]))
    calibration, capture = Calibration(), load_capture(data)
    seeds = [run_seed(capture, seed, calibration) for seed in range(SETTINGS["seeds"])]
    # other programs only ever add time
    figures = means(seeds) | {key: min(f[key] for f in seeds) for key, limit in LIMITS.items() if limit.timed}
    figures["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures["psnr_spread"] = statistics.pstdev(seed["psnr_trained"] for seed in seeds)
    figures["calibration_seconds"] = statistics.median(calibration.seconds)
    return figures


def measure() -> Figures:
    """Measure the room at 160 x 120 in a new process, so that peak memory is its own."""
    os.environ |= THREADS  # read when torch loads OpenMP
    with tempfile.TemporaryDirectory() as folder:
        room = generate(Path(folder) / "room", views=24, width=160, height=120, points=3000)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            return process.submit(run_job, room).result()


def judge(figures: Figures, baseline: Figures, same_cpu: bool) -> tuple[list[list[str]], list[str]]:
    """Compare the figures with the baseline: rows of the table, and names of what is worse. LPIPS without its weights
    is not judged."""
    rows, worse = [], []
    for key, limit in LIMITS.items():
        before, now = baseline.get(key), figures[key]
        verdict, change = "new", ""
        if before is not None:
            change = f"{100 * (now / before - 1):+.1f} %" if limit.relative else f"{now - before:+.{limit.digits}f}"
            allowed = limit.by * (abs(before) if limit.relative else 1.0) * (1.0 if same_cpu else ELSEWHERE)
            verdict = "WORSE" if (now - before) * (-1 if limit.better == "more" else 1) > allowed else "ok"
            if limit.timed and not same_cpu or math.isnan(now):
                verdict = "not judged"
        if verdict == "WORSE":
            worse.append(key)
        shown = [number(value, limit.digits) for value in (before, now)]
        may = f"{100 * limit.by:g} %" if limit.relative else f"{limit.by:g}"
        rows.append([limit.title, *shown, change, may, verdict])
    return rows, worse


def main(accept: bool = False, baseline: Path = BASELINE) -> None:
    """Measure the job and compare it with the baseline.

    Args:
        accept: Make the figures the new baseline.
        baseline: File to compare with, or to write.
    """
    try:
        lpips.load("alex")
    except lpips.LpipsUnavailable as error:
        say(f"gate: LPIPS is not judged: {error}")
        os.environ["BITYMI_NO_DOWNLOAD"] = "1"  # do not try again for every view
    job = {"settings": SETTINGS, "processor": processor()}
    stored = json.loads(baseline.read_text("utf8")) if baseline.is_file() else {**job, "figures": {}}
    if not accept and stored["settings"] != SETTINGS:
        raise SystemExit(f"gate: the baseline is of {stored['settings']}, not of {SETTINGS}")
    figures = measure()
    same_cpu = stored["processor"] == processor()
    rows, worse = judge(figures, stored["figures"], same_cpu)
    if worse and all(LIMITS[key].timed for key in worse) and not accept:
        say("gate: slower than the baseline; timed once more, as the machine may have been busy")
        again = measure()
        figures |= {key: min(figures[key], again[key]) for key, limit in LIMITS.items() if limit.timed}
        rows, worse = judge(figures, stored["figures"], same_cpu)
    print(table(("figure", "baseline", "now", "change", "may be worse by", ""), rows, (0, 5)))
    if not same_cpu:
        print(
            f"\nThe baseline is of {stored['processor']}, this is {processor()}: times are not judged, and the other "
            f"figures may be worse by {ELSEWHERE:g} times as much, as kernels round differently."
        )
    if accept:
        rounded = {name: round(value, 5) for name, value in figures.items() if not math.isnan(value)}
        text = json.dumps({**job, "figures": rounded}, indent=2, sort_keys=True)
        write_file(baseline, (text + "\n").encode())
        print(f"\nThe new baseline is in {baseline}; commit it with the change that it belongs to.")
    elif worse:
        raise SystemExit(
            f"\ngate: {len(worse)} of {len(rows)} figures are worse than the baseline allows. Mend the change, "
            "or accept them with `make gate-accept` and say in the commit why."
        )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
