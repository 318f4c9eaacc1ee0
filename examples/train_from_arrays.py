"""Train and bake a capture from arrays, without nerfstudio.

Reads a transforms.json of undistorted pictures (`bitymi sample --output-dir room` makes one), trains on seven of eight
photographs, and writes a bundle.

python examples/train_from_arrays.py --capture room --bundle room-bundle
"""

import json
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

import bitymi_ns

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def load_views(capture: Path) -> list[bitymi_ns.View]:
    """The photographs with their cameras: transforms.json has camera to world, OpenGL axes; `Camera` world to camera,
    OpenCV axes."""
    info = json.loads((capture / "transforms.json").read_text("utf8"))
    views = []
    for frame in sorted(info["frames"], key=lambda frame: frame["file_path"]):
        image = torch.from_numpy(np.array(Image.open(capture / frame["file_path"])))  # [H, W, 3] uint8
        viewmat = np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENGL_TO_OPENCV)
        fx, fy, cx, cy = (info.get(name, frame.get(name)) for name in ("fl_x", "fl_y", "cx", "cy"))
        K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        camera = bitymi_ns.Camera(torch.from_numpy(viewmat).float(), K, image.shape[1], image.shape[0])
        views.append(bitymi_ns.View(camera, image))
    return views


def main(capture: Path, bundle: Path, steps: int = 1500, points: int = 5000) -> float:
    """Train from random points between the cameras, bake, and print the PSNR of the held-out views in dB."""
    views = load_views(capture)
    held_out, training = views[::8], [view for i, view in enumerate(views) if i % 8]
    centers = torch.stack([view.camera.center for view in training])
    low, high = centers.amin(0), centers.amax(0)
    middle, half = (low + high) / 2, (high - low).max()
    xyz = middle + (2 * torch.rand(points, 3) - 1) * half
    scene, log = bitymi_ns.train_scene(training, xyz, torch.rand(points, 3), steps=steps, eval_views=held_out)
    print(f"trained: {len(scene):,} surfels, {log.entries[-1].psnr:.2f} dB")
    baked = bitymi_ns.bake_scene(scene, training, bundle)
    errors = [(baked.render(v.camera).rgb.clamp(0, 1) - v.target(None, "cpu")).square().mean() for v in held_out]
    psnr = -10 * torch.stack(errors).log10().mean().item()
    print(f"baked: {psnr:.2f} dB in {bundle}")
    return psnr


if __name__ == "__main__":
    tyro.cli(main)
