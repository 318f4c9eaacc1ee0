#!/usr/bin/env python
"""Train a capture on a CUDA card with the core packages alone (nerfstudio is not used) and bake it without fine-tuning:
held-out PSNR against seconds of training, peak memory, bytes of the atlas.

`--device cpu` runs the same on the CPU, to try the script: take few steps and a --downscale.
"""

import math
import sys
import tempfile
import time
from pathlib import Path

import torch
from common import arguments_of, number, page, publish, say, table
from harness import quality
from plain_capture import load_capture

from bitymi_ns.bake import BakeOptions, Learning, bake_and_learn, export
from bitymi_ns.bundle import read_bundle
from bitymi_ns.train.config import REFERENCE_STEPS
from bitymi_ns.train.fit import fit
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.preset import load_preset
from bitymi_ns.train.views import eval_background

CURVE = ("steps", "training s", "surfels", "PSNR dB", "after affine fit")
FIGURES = ("peak MB", "bake s", "atlas MB", "baked PSNR dB")


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--preset", default="bitymi", help="of method_configs (%(default)s)")
    parser.add_argument("--steps", type=int, default=REFERENCE_STEPS, help="length of a run (%(default)s)")
    parser.add_argument("--points", type=int, default=10, help="evaluations over a run (%(default)s)")
    parser.add_argument("--downscale", type=int, default=1, help="whole factor by which photographs are reduced")
    parser.add_argument("--device", default="cuda", help="cuda or cpu (%(default)s)")
    parser.add_argument("--keep", type=Path, help="folder in which the bundle stays")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error("no CUDA device was found (or torch is a CPU build); --device cpu tries the script without")
    capture = load_capture(arguments.data.expanduser(), downscale=arguments.downscale)
    preset, steps = load_preset(arguments.preset), arguments.steps
    config = preset.train
    scene = scene_for_views(capture.train, capture.points, capture.colours, preset.scene, config).to(device)
    due = {math.ceil(steps * (i + 1) / arguments.points) for i in range(arguments.points)}
    log = fit(scene, capture.train, capture.held_out, config, steps, eval_steps=sorted(due))
    peak = torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None
    curve = [
        [number(e.step, 0), number(e.seconds, 1), number(e.surfels, 0), number(e.psnr), number(e.fitted_psnr)]
        for e in log.entries
    ]
    say(", ".join(f"{value} {name}" for name, value in zip(CURVE, curve[-1], strict=True)))
    start = time.perf_counter()
    cameras = [view.camera.to(device) for view in capture.train]
    made = bake_and_learn(
        scene, cameras, (), eval_background(config, torch.device("cpu")), BakeOptions(format="bc7"), Learning()
    )
    seconds = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        target = (arguments.keep or Path(folder)) / f"{arguments.preset}-{steps}"
        export(made, target)
        baked = read_bundle(target).scene.to(device)
    background = eval_background(config, device)
    psnr, *_ = quality(lambda camera: baked.render(camera, background).rgb, capture.held_out, device, background)
    size = 0 if made.atlas is None else made.atlas.nbytes
    figures = [number(peak, 0), number(seconds, 1), number(size / 1e6), number(psnr)]
    camera = capture.held_out[0].camera
    text = (
        f"{len(capture.train)} photographs of {camera.width} x {camera.height}; {len(capture.held_out)} held out.\n\n"
    )
    text += table(("preset", *CURVE, *FIGURES), [[arguments.preset, *curve[-1], *figures]])
    text += "\n\n" + table(CURVE, curve)
    notes = [f"Device: {torch.cuda.get_device_name(device) if device.type == 'cuda' else 'CPU'}."]
    publish(page(f"Training: {arguments.data.name}", text, notes), arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
