"""A training step drawn in bands, against the same step with all fragments at once."""

import torch
from torch import Tensor

from bitymi_ns.ops import Fragments, TexelDescent, Unlisted
from bitymi_ns.scene import Camera, Scene
from bitymi_ns.scene.field import TexelField
from tests.ops.golden import random_scene
from tests.scene.small import scene_of

WIDTH, HEIGHT = 24, 150
"""Ten rows of tiles, the last one partial."""


def make(device: torch.device, most: int, **options: object) -> tuple[Scene, Camera]:
    return scene_of(random_scene(60, 5, WIDTH, HEIGHT), device, max_fragments=most, **options)


def step(device: torch.device, most: int) -> tuple[Fragments | Unlisted, dict[str, Tensor]]:
    """Compute the fragments and all results of a training step."""
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
        "masked counts": output.fragments.masked_counts(mask),
        "mean2d_grad": output.projection.mean2d_grad,
        "mean2d_absgrad": output.projection.mean2d_absgrad,
        **{f"gradient of {name}": p.grad for name, p in scene.named_parameters()},
    }
    return output.fragments, result


def texel_step(device: torch.device, most: int, alpha: bool = False) -> tuple[Fragments | Unlisted, dict[str, Tensor]]:
    """Compute the fragments and the results of a training step that moves texels, with or without alphas."""
    scene, camera = make(device, most, texture_moves_surfels=True)
    g = torch.Generator().manual_seed(2)
    texels = torch.randn(60 * 16, 3, generator=g, dtype=torch.float64)
    size = torch.full((60, 2), 4, dtype=torch.int32)
    share, factors = torch.rand(2, 60 * 16, generator=g, dtype=torch.float64)
    field = TexelField(size, torch.full((60,), 3.0), texels, share, 2 * factors if alpha else None)
    scene.field = field.to(device)
    output = scene.render(camera, maps=True, descent=TexelDescent(scene.field.share, 0.5))
    weight = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(device)
    (output.rgb * weight).sum().backward()
    moved = {"texels": scene.field.texels.detach() - texels.to(device)}
    if scene.field.alpha is not None:
        moved["gradient of alpha"] = scene.field.alpha.grad
    return output.fragments, moved | {f"gradient of {name}": p.grad for name, p in scene.surfels.items()}


def assert_same(got: dict[str, Tensor], want: dict[str, Tensor]) -> None:
    assert got.keys() == want.keys()
    for key, value in want.items():
        assert (got[key] - value).abs().max() <= 1e-9 * value.abs().max(), key
