#!/usr/bin/env python
"""Train a capture on a CUDA card with the core packages alone (nerfstudio is not used), bake it and draw the bundle:
held-out PSNR against seconds of training, peak memory, bytes of the atlas, frames a second of trained and baked scene.

`--device cpu` runs the same on the CPU, to try the script: take few steps and a --downscale.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from common import number, page, publish, say, table
from harness import Options, milliseconds
from plain_capture import Capture, load_capture

from bitymi_ns import bundle
from bitymi_ns.bake import BakeOptions, Learning, bake_and_learn
from bitymi_ns.plugin.run.preset import Preset, PresetError, load_preset
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.domain import build_scene
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.losses import mean_psnr, psnr
from bitymi_ns.train.views import judging_background


class Stages:
    """Progress that adds up the seconds before each report, by what was reported."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, step: str, done: int, total: int) -> None:
        now = time.perf_counter()
        self._seconds[step] = self._seconds.get(step, 0.0) + now - self._last
        self._last = now

    def __str__(self) -> str:
        return ", ".join(f"{step} {seconds:.1f}" for step, seconds in self._seconds.items())


@dataclass
class Result:
    """A run.

    Attributes:
        curve: step, seconds, surfels, held-out psnr, psnr after the affine fit; at points over the run.
        figures: columns of the table beside those of the last point.
    """

    preset: str
    curve: list[tuple[int, float, int, float, float]]
    figures: list[str]


def new_scene(capture: Capture, preset: Preset) -> Scene:
    """Surfels at the points of the capture, with the options of the preset."""
    centers = torch.stack([view.camera.center for view in capture.train])
    pixels = sum(view.camera.width * view.camera.height for view in capture.train)
    bounded = capture.train[0].image.shape[-1] == 4
    scene, _ = build_scene(
        capture.points,
        capture.colours,
        centers,
        preset.scene,
        preset.train,
        bounded,
        image_pixels=pixels,
    )
    return scene


def chosen(name: str, texture: str | None, options: Sequence[str]) -> tuple[str, Preset]:
    """A label, and a preset with another texture and other options, each `group.name=value` of the preset's file.

    Raises:
        PresetError: there is no such option.
    """
    changes = [*options, *([] if texture is None else [f"scene.texture={texture}"])]
    values: dict[str, Any] = {}
    for change in changes:
        keys, _, value = change.partition("=")
        group = values
        *above, last = keys.split(".")
        for key in above:
            group = group.setdefault(key, {})
        group[last] = yaml.safe_load(value)
    label = "-".join([name, *(change.rpartition(".")[2].replace("=", "-") for change in changes)])
    return label, load_preset(name, changes=values)


def waits_of(trainer: Trainer, steps: int) -> float:
    """Mean number of waits of the host for the card in a step, over the next steps."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(steps):
                trainer.advance()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchronizing" in str(w.message) for w in caught) / steps


def run(
    name: str,
    preset: Preset,
    capture: Capture,
    steps: int,
    points: int,
    device: torch.device,
    options: Options,
    keep: Path | None,
) -> Result:
    """Train, bake and draw; the bundle stays in the folder `keep` unless that is None."""
    scene = new_scene(capture, preset).to(device)
    trainer = Trainer(scene, capture.train, preset.train, steps)
    due = {math.ceil(steps * (i + 1) / points) for i in range(points)}
    cuda = device.type == "cuda"
    pixels = capture.held_out[0].camera.width * capture.held_out[0].camera.height
    if cuda:
        torch.cuda.reset_peak_memory_stats(device)
    curve, seconds, waits = [], 0.0, None
    while trainer.step < steps:
        start = time.perf_counter()
        if cuda and trainer.step == steps - 20:
            waits = waits_of(trainer, 20)
        else:
            trainer.advance()
        if cuda and trainer.step in due:
            torch.cuda.synchronize(device)
        seconds += time.perf_counter() - start
        if trainer.step in due:
            trainer.training.watch.finish(scene)
            quality = evaluate(scene, capture.held_out, preset.train)
            curve.append((trainer.step, seconds, len(scene), quality.psnr, quality.cc_psnr))
            say(
                f"{name}: step {trainer.step:,} of {steps:,}, {seconds:.1f} s, {quality.psnr:.2f} dB "
                f"({quality.cc_psnr:.2f} after the affine fit), {len(scene):,} surfels, "
                f"{quality.fragments / pixels:.1f} fragments per pixel"
            )
    peak = torch.cuda.max_memory_allocated(device) if cuda else 0
    camera = capture.held_out[0].camera.to(device)
    with torch.no_grad():
        frame = milliseconds(lambda: scene.render(camera, field_mode="frozen"), options)
    start = time.perf_counter()
    background = judging_background(preset.train, torch.device("cpu"))
    cameras = [view.camera.to(device) for view in capture.train]
    stages = Stages()
    made = bake_and_learn(scene, cameras, (), background, BakeOptions(), Learning(), stages)  # nothing learns
    bake_seconds = time.perf_counter() - start
    say(f"{name}: bake, seconds by what was reported at the end of them: {stages}")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder if keep is None else keep) / f"{name}-{steps}"
        bundle.export(made, target)
        baked = bundle.read_bundle(target).scene
    if cuda:
        baked = baked.to(device)
    baked_frame = milliseconds(lambda: baked.render(camera), options)
    size = 0 if made.atlas is None else made.atlas.nbytes
    figures = [number(peak / 1e6, 0), number(waits, 1), number(1e3 / frame, 0), number(bake_seconds, 1)]
    figures += [number(size / 1e6, 2), number(_psnr(baked, capture, preset, device)), number(1e3 / baked_frame, 0)]
    return Result(name, curve, figures)


def _psnr(baked: BakedScene, capture: Capture, preset: Preset, device: torch.device) -> float:
    background = judging_background(preset.train, device)
    values = []
    for view in (view.to(device) for view in capture.held_out):
        rgb = baked.render(view.camera, background).rgb.clamp(0, 1)
        values.append(psnr(rgb, view.target(background, device), view.mask))
    return mean_psnr(values)


def report(results: list[Result], capture: Capture) -> str:
    """Markdown."""

    def cells(point: tuple) -> list[str]:
        step, seconds, surfels, *quality = point
        return [number(step, 0), number(seconds, 1), number(surfels, 0), *map(number, quality)]

    camera = capture.held_out[0].camera
    points = ("steps", "training s", "surfels", "PSNR dB", "after affine fit")
    header = ("preset", *points, "peak MB", "waits a step", "frames/s", "bake s", "atlas MB", "baked PSNR dB")
    text = f"{len(capture.train)} photographs of {camera.width} x {camera.height}; {len(capture.held_out)} held out."
    rows = [[r.preset, *cells(r.curve[-1]), *r.figures] for r in results]
    text += "\n\n" + table((*header, "baked frames/s"), rows)
    for r in results:
        text += f"\n\n#### {r.preset}\n\n" + table(points, [cells(point) for point in r.curve])
    return text


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument(
        "--presets", nargs="+", default=["bitymi", "bitymi-quality"], help="method_configs (%(default)s)"
    )
    parser.add_argument(
        "--textures", nargs="+", choices=("hash", "texels", "none"), help="each of them in place of a preset's own"
    )
    parser.add_argument(
        "--options", nargs="+", default=[], metavar="KEY=VALUE", help="of the presets' files: train.exposure=auto"
    )
    parser.add_argument("--steps", type=int, help="length of a run; default: the preset's on a GPU")
    parser.add_argument("--points", type=int, default=10, help="evaluations over a run (%(default)s)")
    parser.add_argument("--downscale", type=int, default=1, help="whole factor by which photographs are reduced")
    parser.add_argument("--device", default="cuda", help="cuda or cpu (%(default)s)")
    parser.add_argument("--warm-up", type=int, default=10, help="frames before those that are timed (%(default)s)")
    parser.add_argument("--runs", type=int, default=200, help="frames that are timed (%(default)s)")
    parser.add_argument("--keep", type=Path, help="folder in which the bundles stay")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error("no CUDA device is to be seen (or torch is a CPU build); --device cpu tries the script without")
    try:
        capture = load_capture(arguments.data.expanduser(), downscale=arguments.downscale)
    except (OSError, KeyError, ValueError) as error:
        parser.error(f"the capture {arguments.data} cannot be read: {error}")
    options = Options(device, arguments.warm_up, arguments.runs)
    what: Any = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    notes = [f"Device: {what}.", f"Frames: median of about {arguments.runs} after {arguments.warm_up}."]
    results, failed = [], False
    textures = arguments.textures or (None,)
    try:
        runs = [chosen(name, texture, arguments.options) for name in arguments.presets for texture in textures]
    except PresetError as error:
        parser.error(str(error))
    for name, preset in runs:
        steps = arguments.steps or preset.trainer.iterations
        points = min(arguments.points, steps)
        try:
            results.append(run(name, preset, capture, steps, points, device, options, arguments.keep))
        except (RuntimeError, ValueError, OSError) as error:
            traceback.print_exc()
            notes.append(f"{name} failed: {' '.join(str(error).split())[:400]}")
            failed = True
        last = name == runs[-1][0]
        text = page(f"Training on a card: {arguments.data.name}", report(results, capture), notes)
        publish(text, arguments.output, silent=not last)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
