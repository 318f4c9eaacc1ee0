"""Alpha texels: fragments and gradients against finite differences and a loop over pixels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.scene.camera import Camera

SIDE = 32
NAMES = ("means", "quats", "log_scales", "logits", "beta_raw", "base", "texels", "alpha")


@pytest.fixture
def scene() -> tuple[dict[str, Tensor], ops.TexelTiles, Camera]:
    random = torch.Generator().manual_seed(0)
    n, options = 12, {"generator": random, "dtype": torch.float64}
    means = torch.randn(n, 3, **options) * 0.5
    means[:, 2] = torch.linspace(2.5, 3.5, n)
    size = torch.randint(1, 6, (n, 2), generator=random, dtype=torch.int32)
    size[3] = 0
    tiles = ops.TexelTiles.of_sizes(size, torch.rand(n, **options) + 1.5)
    logits = torch.randn(n, **options)
    logits[0] = 8.0  # sigma is clamped
    values = (
        *(means, torch.randn(n, 4, **options), -1.6 + 0.2 * torch.randn(n, 2, **options), logits),
        *(torch.randn(n, **options), torch.rand(n, 3, **options) - 0.3),
        *(0.4 * torch.rand(tiles.count, 3, **options) - 0.2, 0.3 + torch.rand(tiles.count, **options)),
    )
    K = torch.tensor([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    return dict(zip(NAMES, values, strict=True)), tiles, Camera(torch.eye(4), K, SIDE, SIDE)


@pytest.mark.parametrize("bound", [0.0, 0.05])
def test_gradients_are_those_of_differences(scene, bound):
    values, tiles, camera = scene
    weights = torch.randn(SIDE * SIDE, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(*given: Tensor) -> Tensor:
        *surfels, base, texels, alpha = given
        projection = ops.project(*surfels, camera, 0.05)
        cut = replace(projection, alpha=ops.TexelAlpha(tiles, alpha, bound))
        return (ops.blended_image(ops.trace(cut, rim=1e-3), projection, base, texels, tiles, 0.0) * weights).sum()

    leaves = [value.requires_grad_() for value in values.values()]
    assert torch.autograd.gradcheck(loss, leaves, atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_fragments_are_those_of_a_loop_over_pixels(scene):
    values, tiles, camera = scene
    projection = ops.project(*(values[name] for name in NAMES[:5]), camera, 0.05)
    alpha = values["alpha"]
    uncut, cut = ops.trace(projection), ops.trace(replace(projection, alpha=ops.TexelAlpha(tiles, alpha, 0.0)))
    surfel = uncut.surfel.long()
    size, extent = tiles.size[surfel].double(), tiles.extent[surfel]

    def axis(u: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = torch.minimum(((u + extent) / (2 * extent) * r - 0.5).clamp_min(0), (r - 1).clamp_min(0))
        return x.floor().long(), torch.minimum(x.floor() + 1, r - 1).long(), x - x.floor()

    x0, x1, fx = axis(uncut.uv[0], size[:, 0])
    y0, y1, fy = axis(uncut.uv[1], size[:, 1])
    at = lambda x, y: alpha[(tiles.first[surfel] + y * size[:, 0].long() + x).clamp(0, tiles.count - 1)]  # noqa: E731
    mixed = (1 - fy) * ((1 - fx) * at(x0, y0) + fx * at(x1, y0)) + fy * ((1 - fx) * at(x0, y1) + fx * at(x1, y1))
    sigma = (uncut.sigma.abs() * torch.where(size[:, 0] > 0, mixed, 1.0)).clamp(max=0.99)
    passing, expected = torch.ones(SIDE * SIDE, dtype=torch.float64), {}
    for s, p, a in zip(uncut.surfel.tolist(), uncut.pixel.tolist(), sigma.tolist(), strict=True):
        if a >= 1 / 255:
            expected[s, p] = a * float(passing[p])
            passing[p] -= expected[s, p]
    found = dict(zip(zip(cut.surfel.tolist(), cut.pixel.tolist(), strict=True), cut.weight.tolist(), strict=True))
    assert found == pytest.approx(expected, abs=1e-14)


@torch.no_grad()
def test_alphas_of_one_change_nothing(scene):
    values, tiles, camera = scene
    projection = ops.project(*(values[name] for name in NAMES[:5]), camera, 0.05)
    ones = ops.TexelAlpha(tiles, torch.ones_like(values["alpha"]), 0.0)
    plain, cut = ops.trace(projection), ops.trace(replace(projection, alpha=ones))
    assert torch.equal(plain.weight, cut.weight)
