"""Train and bake a capture from arrays, without nerfstudio.

Loads a capture of any format (`bitymi sample --output-dir room` makes one), trains on seven of eight photographs, and
writes a bundle.

python examples/train_from_arrays.py --capture room --bundle room-bundle
"""

from pathlib import Path

import torch
import tyro

import bitymi_ns


def main(capture: Path, bundle: Path, steps: int = 1500) -> float:
    """Train from the capture's points, bake, and print and return the mean PSNR of the held-out views in dB."""
    training, points, colors = bitymi_ns.load_capture(capture, "train")
    held_out, *_ = bitymi_ns.load_capture(capture, "test", points="random")
    scene, log = bitymi_ns.train_scene(training, points, colors, steps=steps, eval_views=held_out)
    print(f"trained: {len(scene):,} surfels, {log.entries[-1].psnr:.2f} dB")
    baked = bitymi_ns.bake_scene(scene, training, bundle)
    errors = [(baked.render(v.camera).rgb.clamp(0, 1) - v.target(None, "cpu")).square().mean() for v in held_out]
    psnr = -10 * torch.stack(errors).log10().mean().item()
    print(f"baked: {psnr:.2f} dB in {bundle}")
    return psnr


if __name__ == "__main__":
    tyro.cli(main)
