"""Fit surfels to one picture by gradient descent through `bitymi_ns.rasterize`.

python examples/fit_image.py --image photo.jpg --output fitted.png
"""

from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

import bitymi_ns


def main(image: Path, output: Path, surfels: int = 2000, steps: int = 300, size: int = 256) -> float:
    """Optimize surfels on a plane in front of the camera; return the last mean square error.

    Args:
        size: longest side to which the picture is reduced, pixels.
    """
    photo = Image.open(image).convert("RGB")
    photo.thumbnail((size, size))
    target = torch.from_numpy(np.asarray(photo, dtype=np.float32) / 255.0)  # [H, W, 3]
    height, width = target.shape[:2]
    K = torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])
    camera = bitymi_ns.Camera(torch.eye(4), K, width, height)  # at the origin, looks along +z

    torch.manual_seed(0)
    means = torch.rand(surfels, 3) - 0.5
    means[:, 1] *= height / width
    means[:, 2] = 1.0 + 0.01 * means[:, 2]
    parameters = {
        "means": means,  # [N, 3]
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(surfels, 1),  # [N, 4] wxyz, facing the camera
        "log_scales": torch.full((surfels, 2), -4.0),
        "opacity_logits": torch.zeros(surfels),
        "beta_raw": torch.zeros(surfels),
        "colors": torch.rand(surfels, 3),
    }
    for value in parameters.values():
        value.requires_grad_()
    optimizer = torch.optim.Adam(parameters.values(), lr=0.01)
    for step in range(steps):
        means, quats, log_scales, opacities, betas, colors = parameters.values()
        activated = log_scales.exp(), opacities.sigmoid(), 4.0 * betas.sigmoid()
        drawn = bitymi_ns.rasterize(means, quats, *activated, colors, camera)
        loss = (drawn.rgb - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step == steps - 1:
            print(f"step {step}: mean square error {loss.item():.5f}")
    pixels = (drawn.rgb.detach().clamp(0, 1) * 255).round().byte().numpy()
    Image.fromarray(pixels).save(output)
    return loss.item()


if __name__ == "__main__":
    tyro.cli(main)
