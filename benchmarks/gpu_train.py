#!/usr/bin/env python
"""Train a capture on a CUDA card with the core packages alone (nerfstudio is not used), bake it and draw the bundle:
held-out PSNR against seconds of training, peak memory, bytes of the atlas, frames a second of trained and baked scene.

`--device cpu` runs the same on the CPU, to try the script: take few steps and a --downscale.
"""

import math
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from common import arguments_of, number, page, publish, say, table
from harness import Options, milliseconds
from plain_capture import Capture, load_capture

from bitymi_ns.bake import BakeOptions, Learning, bake_and_learn, export
from bitymi_ns.bundle import read_bundle
from bitymi_ns.plugin.run.preset import Preset, load_preset
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.train.config import REFERENCE_STEPS
from bitymi_ns.train.domain import scene_for_views
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.losses import mean_psnr, psnr
from bitymi_ns.train.views import eval_background

CURVE = ("steps", "training s", "surfels", "PSNR dB", "after affine fit")
FIGURES = ("peak MB", "waits a step", "frames/s", "bake s", "atlas MB", "baked PSNR dB", "baked frames/s")


def preset_of(name: str, options: Sequence[str]) -> Preset:
    """A preset with other options, each `group.name=value` of the preset's file.

    Raises:
        PresetError: there is no such option.
    """
    values: dict[str, Any] = {}
    for change in options:
        keys, _, value = change.partition("=")
        group = values
        *above, last = keys.split(".")
        for key in above:
            group = group.setdefault(key, {})
        group[last] = yaml.safe_load(value)
    return load_preset(name, changes=values)


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
    preset: Preset, capture: Capture, steps: int, points: int, options: Options, target: Path
) -> tuple[list[list[str]], list[str]]:
    """Train, bake into the folder `target` and draw; returns the rows of the curve, and FIGURES."""
    device, cuda = options.device, options.device.type == "cuda"
    scene = scene_for_views(capture.train, capture.points, capture.colours, preset.scene, preset.train).to(device)
    trainer = Trainer(scene, capture.train, preset.train, steps)
    due = {math.ceil(steps * (i + 1) / points) for i in range(points)}
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
            row = [number(trainer.step, 0), number(seconds, 1), number(len(scene), 0)]
            curve.append([*row, number(quality.psnr), number(quality.cc_psnr)])
            say(", ".join(f"{value} {name}" for name, value in zip(CURVE, curve[-1], strict=True)))
    peak = torch.cuda.max_memory_allocated(device) if cuda else 0
    camera = capture.held_out[0].camera.to(device)
    with torch.no_grad():
        frame = milliseconds(lambda: scene.render(camera, field_mode="frozen"), options)
    start = time.perf_counter()
    background = eval_background(preset.train, torch.device("cpu"))
    cameras = [view.camera.to(device) for view in capture.train]
    made = bake_and_learn(scene, cameras, (), background, BakeOptions(), Learning())  # without fine-tuning
    bake_seconds = time.perf_counter() - start
    export(made, target)
    baked = read_bundle(target).scene.to(device)
    baked_frame = milliseconds(lambda: baked.render(camera), options)
    size = 0 if made.atlas is None else made.atlas.nbytes
    figures = [number(peak / 1e6, 0), number(waits, 1), number(1e3 / frame, 0), number(bake_seconds, 1)]
    figures += [number(size / 1e6), number(_psnr(baked, capture, preset, device)), number(1e3 / baked_frame, 0)]
    return curve, figures


def _psnr(baked: BakedScene, capture: Capture, preset: Preset, device: torch.device) -> float:
    background = eval_background(preset.train, device)
    values = []
    for view in (view.to(device) for view in capture.held_out):
        rgb = baked.render(view.camera, background).rgb.clamp(0, 1)
        values.append(psnr(rgb, view.target(background, device), view.mask))
    return mean_psnr(values)


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--preset", default="bitymi", help="of method_configs (%(default)s)")
    parser.add_argument(
        "--options", nargs="+", default=[], metavar="KEY=VALUE", help="of the preset's file: scene.texture=hash"
    )
    parser.add_argument("--steps", type=int, help="length of a run; default: the preset's on a GPU")
    parser.add_argument("--points", type=int, default=10, help="evaluations over a run (%(default)s)")
    parser.add_argument("--downscale", type=int, default=1, help="whole factor by which photographs are reduced")
    parser.add_argument("--device", default="cuda", help="cuda or cpu (%(default)s)")
    parser.add_argument("--warm-up", type=int, default=10, help="frames before those that are timed (%(default)s)")
    parser.add_argument("--runs", type=int, default=200, help="frames that are timed (%(default)s)")
    parser.add_argument("--keep", type=Path, help="folder in which the bundle stays")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error("no CUDA device was found (or torch is a CPU build); --device cpu tries the script without")
    capture = load_capture(arguments.data.expanduser(), downscale=arguments.downscale)
    preset = preset_of(arguments.preset, arguments.options)
    options = Options(device, arguments.warm_up, arguments.runs)
    steps = arguments.steps or REFERENCE_STEPS
    name = "-".join([arguments.preset, *(o.rpartition(".")[2].replace("=", "-") for o in arguments.options)])
    with tempfile.TemporaryDirectory() as folder:
        target = (arguments.keep or Path(folder)) / f"{name}-{steps}"
        curve, figures = run(preset, capture, steps, min(arguments.points, steps), options, target)
    camera = capture.held_out[0].camera
    held_out = f"{len(capture.held_out)} held out"
    text = f"{len(capture.train)} photographs of {camera.width} x {camera.height}; {held_out}.\n\n"
    text += table(("preset", *CURVE, *FIGURES), [[name, *curve[-1], *figures]]) + "\n\n" + table(CURVE, curve)
    notes = [
        f"Device: {torch.cuda.get_device_name(device) if device.type == 'cuda' else 'CPU'}.",
        f"Frames: median of about {arguments.runs} after {arguments.warm_up}.",
    ]
    publish(page(f"Training: {arguments.data.name}", text, notes), arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
