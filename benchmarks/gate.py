#!/usr/bin/env python
"""A fixed small job, compared with the committed baseline: quality, bytes, memory and time may not get worse unnoticed.

Each scene is trained, baked, tuned, written and drawn in a process of its own, with one thread and with several seeds,
whose mean counts: training is chaotic, so that a change of rounding alone moves one seed by more than the limit. CPU
seconds are divided by those of a calibration that has nothing of this package in it and runs before, between and after
the parts, so that a busy machine, or a slower one of the same kind, gives the same figures. With `--accept` the figures
become the new baseline, benchmarks/gate.json; the commit then shows what changed.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

BASELINE = Path(__file__).with_suffix(".json")
THREADS = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}


@dataclass(frozen=True)
class Settings:
    """The job: training steps, steps of texel tuning, and how many seeds."""

    steps: int = 300
    tuning: int = 100
    seeds: int = 4


@dataclass(frozen=True)
class Limit:
    """How much worse a figure may be than the baseline.

    Attributes:
        better: whether "more" or "less" of it is better.
        by: the largest step in the wrong direction.
        relative: `by` is a share of the baseline and not a difference.
        digits: that are shown.
        timed: depends on the kind of processor; judged only where it is that of the baseline.
    """

    better: str
    by: float
    relative: bool = True
    digits: int = 0
    timed: bool = False

    def worse(self, value: float, baseline: float) -> bool:
        """Whether the figure is worse than the baseline by more than it may be."""
        loss = baseline - value if self.better == "more" else value - baseline
        return loss > (self.by * abs(baseline) if self.relative else self.by)


LIMITS = {
    "psnr_neural": Limit("more", 0.05, relative=False, digits=3),
    "psnr_baked": Limit("more", 0.05, relative=False, digits=3),
    "bundle_bytes": Limit("less", 0.03),
    "surfels": Limit("less", 0.03),
    "fragments_per_pixel": Limit("less", 0.03, digits=2),
    "peak_mb": Limit("less", 0.10),
    "train": Limit("less", 0.15, digits=2, timed=True),
    "bake": Limit("less", 0.15, digits=2, timed=True),
    "frame": Limit("less", 0.15, digits=4, timed=True),
}
UNITS = {
    "psnr_neural": "PSNR neural, dB",
    "psnr_baked": "PSNR baked, dB",
    "bundle_bytes": "bundle, bytes",
    "surfels": "surfels",
    "fragments_per_pixel": "fragments per pixel",
    "peak_mb": "peak memory, MB",
    "train": "training, calibrations",
    "bake": "bake and tuning, calibrations",
    "frame": "a baked frame, calibrations",
}


class Calibration:
    """CPU seconds of a fixed piece of work in torch alone: a matrix product, a sort, and a gather from 32 MB."""

    def __init__(self) -> None:
        import torch

        generator = torch.Generator().manual_seed(0)
        self._matrix = torch.randn(640, 640, generator=generator)
        self._keys = torch.rand(400_000, generator=generator)
        self._table = torch.rand(1 << 21, 4, generator=generator)
        self._rows = torch.randint(1 << 21, (1_000_000,), generator=generator)
        self.seconds: list[float] = []
        self.run()
        self.seconds.clear()  # the first one warms up

    def run(self, repeats: int = 3) -> None:
        """Do the work a few times more."""
        for _ in range(repeats):
            start = time.process_time()
            x = self._matrix
            for _ in range(4):
                x = (x @ self._matrix).tanh()
            self._keys.argsort()
            self._table[self._rows].sum()
            self.seconds.append(time.process_time() - start)

    @property
    def unit(self) -> float:
        """The median so far."""
        return statistics.median(self.seconds)


def timed(calibration: Calibration, work: Callable[[], Any]) -> tuple[Any, float]:
    """What `work` returns, and its CPU seconds."""
    start = time.process_time()
    result = work()
    seconds = time.process_time() - start
    calibration.run()
    return result, seconds


def run_job(data: Path, downscale: int, steps: int, tuning: int, seeds: int) -> dict[str, float]:
    """The figures of one scene, in this process: their means over the seeds, but for the peak memory."""
    import torch
    from plain_capture import load_capture

    from bitymi_ns.bake import BakeOptions, TuneOptions, bake, export, read_bundle, tune_atlas
    from bitymi_ns.scene.baked import BakedScene
    from bitymi_ns.scene.config import SceneConfig
    from bitymi_ns.train.config import TrainConfig
    from bitymi_ns.train.domain import build_scene
    from bitymi_ns.train.evaluate import evaluate
    from bitymi_ns.train.fit import fit
    from bitymi_ns.train.losses import psnr
    from bitymi_ns.train.views import as_float

    torch.set_num_threads(int(THREADS["OMP_NUM_THREADS"]))
    calibration = Calibration()
    capture = load_capture(data, downscale=downscale)
    views, held_out = capture.train, capture.held_out
    cameras = [view.camera for view in views]
    centers = torch.stack([camera.center for camera in cameras])
    pixels = sum(camera.width * camera.height for camera in cameras)
    view_pixels = held_out[0].camera.width * held_out[0].camera.height
    background = torch.zeros(3)
    found: dict[str, list[float]] = {key: [] for key in LIMITS if key != "peak_mb"}
    for seed in range(seeds):
        config = TrainConfig(seed=seed)
        scene, _ = build_scene(capture.points, capture.colours, centers, SceneConfig(), config, False, pixels)
        _, train = timed(calibration, lambda scene=scene, config=config: fit(scene, views, [], config, steps))
        neural, fragments = evaluate(scene, held_out, config)

        def make(scene: Any = scene) -> Any:
            baked = bake(scene, cameras, BakeOptions())
            return tune_atlas(baked, views, background, TuneOptions(steps=tuning))

        baked, baking = timed(calibration, make)
        with tempfile.TemporaryDirectory() as folder:
            bundle = Path(folder) / "bundle"
            export(baked, bundle)
            size = sum(path.stat().st_size for path in bundle.iterdir())
            drawn = BakedScene.from_bundle(read_bundle(bundle))
        quality, frames = [], []
        for view in held_out * 3:
            image, seconds = timed(
                calibration, lambda view=view, drawn=drawn: drawn.render(view.camera, background).rgb
            )
            frames.append(seconds)
            quality.append(psnr(image.clamp(0.0, 1.0), as_float(view.image)))
        figures = {
            "psnr_neural": neural,
            "psnr_baked": statistics.fmean(quality),
            "bundle_bytes": size,
            "surfels": len(scene),
            "fragments_per_pixel": fragments / view_pixels,
            "train": train,
            "bake": baking,
            "frame": statistics.median(frames),
        }
        for key, value in figures.items():
            found[key].append(value)
    means = {key: statistics.fmean(values) for key, values in found.items()}
    for key in (key for key, limit in LIMITS.items() if limit.timed):
        means[key] /= calibration.unit
    means["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    means["calibration_seconds"] = calibration.unit
    means["psnr_spread"] = statistics.stdev(found["psnr_neural"]) if seeds > 1 else 0.0
    return means


def in_a_process(data: Path, downscale: int, settings: Settings) -> dict[str, float]:
    """`run_job` in a process of its own, whose peak memory is that of the job."""
    numbers = [str(n) for n in (downscale, *asdict(settings).values())]
    command = [sys.executable, __file__, "--job", str(data), *numbers]
    done = subprocess.run(command, env={**os.environ, **THREADS}, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"gate: {' '.join(command)} ended with exit status {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def judge(
    name: str, found: dict[str, float], baseline: dict[str, float], same_cpu: bool
) -> tuple[list[list[str]], int]:
    """The lines of one scene for the table, and how many of its figures are worse than they may be."""
    rows, failed = [], 0
    for key, limit in LIMITS.items():
        value, before = found[key], baseline.get(key)
        allowed = f"{limit.by:.0%}" if limit.relative else f"{limit.by:g}"
        if before is None:
            verdict, change = "new", ""
        else:
            change = f"{100 * (value / before - 1):+.1f} %" if limit.relative else f"{value - before:+.{limit.digits}f}"
            if limit.timed and not same_cpu:
                verdict = "not judged"
            elif limit.worse(value, before):
                verdict, failed = "WORSE", failed + 1
            else:
                verdict = "ok"
        shown = ["" if v is None else f"{v:,.{limit.digits}f}" for v in (before, value)]
        rows.append([name, UNITS[key], *shown, change, allowed, verdict])
    return rows, failed


def measure(settings: Settings, capture: Path | None) -> dict[str, dict[str, float]]:
    """The figures of the room at 160 x 120, and of a capture at half its size."""
    from common import say

    from bitymi_ns.sample import generate

    found = {}
    with tempfile.TemporaryDirectory() as folder:
        say("gate: the room")
        room = generate(Path(folder) / "room", views=24, width=160, height=120, points=3000)
        found["room"] = in_a_process(room, 1, settings)
    if capture is not None:
        say(f"gate: {capture.name}")
        found[capture.name] = in_a_process(capture.absolute(), 2, settings)
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, help="an undistorted capture to run at half its size beside the room")
    parser.add_argument("--accept", action="store_true", help="make the figures the new baseline")
    parser.add_argument("--baseline", type=Path, default=BASELINE, help="the file to compare with, or to write")
    for field in fields(Settings):
        parser.add_argument(f"--{field.name}", type=int, default=field.default)
    parser.add_argument("--job", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        print(json.dumps(run_job(Path(options.job[0]), *map(int, options.job[1:]))))
        return
    from common import table

    from bitymi_ns.bench.machine import processor
    from bitymi_ns.files import write_file

    settings = Settings(options.steps, options.tuning, options.seeds)
    empty = {"settings": asdict(settings), "processor": processor(), "scenes": {}}
    baseline = json.loads(options.baseline.read_text("utf8")) if options.baseline.is_file() else empty
    if not options.accept and baseline["settings"] != asdict(settings):
        raise SystemExit(f"gate: the baseline is of {baseline['settings']}, not of {asdict(settings)}")
    found = measure(settings, options.capture)
    same_cpu = baseline["processor"] == processor()
    rows, failed = [], 0
    for name, figures in found.items():
        lines, bad = judge(name, figures, baseline["scenes"].get(name, {}), same_cpu)
        rows, failed = rows + lines, failed + bad
    print(table(("scene", "figure", "baseline", "now", "change", "may be worse by", ""), rows, 2))
    if not same_cpu:
        print(f"\nTimes are not judged: the baseline is of {baseline['processor']}, this is {processor()}.")
    if options.accept:
        rounded = {name: {k: round(v, 5) for k, v in figures.items()} for name, figures in found.items()}
        # those of other captures stay, as far as they are of the same job on the same kind of machine
        kept = baseline["scenes"] if {**baseline, "scenes": {}} == {**empty, "scenes": {}} else {}
        text = json.dumps({**empty, "scenes": {**kept, **rounded}}, indent=2, sort_keys=True)
        write_file(options.baseline, (text + "\n").encode())
        print(f"\nThe new baseline is in {options.baseline}; commit it with the change that it belongs to.")
    elif failed:
        raise SystemExit(
            f"\ngate: {failed} of {len(rows)} figures are worse than the baseline allows. Mend the change, or accept "
            "them with `make gate-accept` and say in the commit why."
        )


if __name__ == "__main__":
    main()
