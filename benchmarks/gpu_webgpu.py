#!/usr/bin/env python
"""Draw bundles through WebGPU on the graphics device of this machine, beside the CUDA renderer where there is one:
median ms per frame, and differences of the pictures.

A frame through WebGPU is queued many times without reading it back, so that neither the copy to the host nor its
waiting is measured; its sums have the precision that the device blends in. The CUDA frame is a recorded graph with
8 bits per channel. `--layers` are the batches in which surfels are drawn (docs/viewer.md).
"""

import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from common import arguments_of, number, page, publish, say, table
from gpu_baked import around, measured
from harness import Options

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops import webgpu
from bitymi_ns.ops.webgpu.device import adapters, device
from bitymi_ns.ops.webgpu.on_device import SceneOnDevice
from bitymi_ns.scene.camera import Camera

HEADER = ("bundle", "surfels", "size", "layers", "WebGPU ms", "CUDA ms", "WebGPU / CUDA", "mean error / 255", "largest")


def webgpu_milliseconds(scene: SceneOnDevice, camera: Camera, layers: int, runs: int) -> float:
    """Median over three rounds of the time per frame of `runs` queued ones, without the time of the first."""
    small = Camera(camera.viewmat, camera.K, 1, 1)

    def seconds(count: int) -> float:
        start = time.perf_counter()
        for _ in range(count):
            scene.begin(camera, "color", layers)
        scene.draw(small, "color", 1)  # waits for all of them
        return time.perf_counter() - start

    seconds(3)
    return 1e3 * statistics.median((seconds(runs + 1) - seconds(1)) / runs for _ in range(3))


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("bundles", nargs="+", type=Path)
    parser.add_argument("--sizes", nargs="+", default=["1297x840", "3840x2160"], metavar="WxH")
    parser.add_argument("--layers", nargs="+", type=int, default=[1, 16])
    parser.add_argument("--runs", type=int, default=10, help="frames of a round (%(default)s)")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file, anew after each row")
    arguments = parser.parse_args()
    if not adapters():
        parser.error("no graphics device for WebGPU was found")
    card = torch.cuda.is_available()
    rows: list[list[str]] = []
    features = ", ".join(name for name in sorted(device().features) if "compression" in name or "float32" in name)
    notes = [f"Graphics devices: {'; '.join(adapters())}. Features: {features}."]
    for folder in arguments.bundles:
        bundle = read_bundle(folder, decode=False)
        plain = replace(bundle.scene, photographed=None)  # one sample per pixel, as the timed frames have
        there = SceneOnDevice(plain)
        for size in arguments.sizes:
            width, height = (int(part) for part in size.split("x"))
            cameras = around(bundle, width, height)
            cuda = None
            pictures = []
            if card:
                scene, options = plain.to("cuda"), Options(torch.device("cuda"), 5, arguments.runs)
                cuda = measured(scene, cameras, options)["packed"]
                pictures = [scene.render(camera).rgb.cpu() for camera in cameras]
            for layers in arguments.layers:
                ms = statistics.fmean(webgpu_milliseconds(there, camera, layers, arguments.runs) for camera in cameras)
                errors = [
                    255 * (webgpu.draw(plain, [camera], None, ("rgb",), layers=layers)["rgb"][0] - picture).abs()
                    for camera, picture in zip(cameras, pictures, strict=False)
                ]
                mean = statistics.fmean(float(e.mean()) for e in errors) if errors else None
                most = max(float(e.max()) for e in errors) if errors else None
                say(f"{folder.name}, {size}, {layers} layers: {ms:.3f} ms")
                ratio = None if cuda is None else ms / cuda
                row = [folder.name, number(len(bundle), 0), f"{width} x {height}", number(layers, 0), number(ms, 3)]
                rows.append([*row, number(cuda, 3), number(ratio, 1), number(mean, 2), number(most, 0)])
                text = page("Bundles through WebGPU", table(HEADER, rows), notes)
                publish(text, arguments.output, silent=True)
    publish(page("Bundles through WebGPU", table(HEADER, rows), notes), arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
