"""A training step whose view is drawn in bands, against the same step with all fragments at once."""

from __future__ import annotations

import torch
from torch import Tensor

from bitymi_ns.ops import Bands
from bitymi_ns.scene import Camera, HashField, Scene, SceneConfig
from tests.ops.golden import random_scene

WIDTH, HEIGHT = 24, 150
"""Ten rows of tiles, the last one cut off."""


def make(device: torch.device, most: int, **options: object) -> tuple[Scene, Camera]:
    case = random_scene(60, 5, WIDTH, HEIGHT)
    config = SceneConfig(min_resolution=8, max_fragments=most, **options)
    g = torch.Generator().manual_seed(0)
    field = HashField(config, (0.1, -0.2, 0.3), 3.0, True, 8, g)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=g) * 0.5)
    scene = Scene(config, case.params, field).to(device, torch.float64)
    return scene, Camera(case.viewmat, case.K, WIDTH, HEIGHT).to(device)


def step(device: torch.device, most: int) -> tuple[Bands | object, dict[str, Tensor]]:
    """The fragments, and all that a training step gives."""
    scene, camera = make(device, most, texture_moves_surfels=True)
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, device=device)
    output = scene.render(camera, background, maps=True, overdraw_half=0.005)
    weight = torch.rand(HEIGHT, WIDTH, 10, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(device)
    maps = (output.alpha, output.beta, output.depth, output.normal, output.soft_overdraw)
    image = torch.cat([output.rgb, *maps], -1)
    (image * weight).sum().backward()
    mask = weight[..., 0] > 0.7
    result = {
        "image": image.detach(),
        "overdraw": output.overdraw,
        "masked counts": output.fragments.masked_counts(mask, len(scene)),
        "mean2d_grad": output.projection.mean2d_grad,
        "mean2d_absgrad": output.projection.mean2d_absgrad,
        **{f"gradient of {name}": p.grad for name, p in scene.named_parameters()},
    }
    return output.fragments, result


def assert_same(got: dict[str, Tensor], want: dict[str, Tensor]) -> None:
    assert got.keys() == want.keys()
    for key, value in want.items():
        assert (got[key] - value).abs().max() <= 1e-9 * value.abs().max(), key
