"""Texels of a baked scene at given coordinates, as the renderers fetch them."""

import torch
from torch import Tensor

from bitymi_ns.scene.baked import BakedScene


def fetch_texels(scene: BakedScene, tiles: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Fetch texels: bilinear between texel centres, constant beyond the outer ones.

    Args:
        scene: on the CPU, with an atlas.
        tiles: [n, 5] int64, of the scene.
        u, v: [n, r_u] and [n, r_v] coordinates in units of the half sides of the tiles, from -1 to 1 within them.

    Returns:
        [n, r_v, r_u, 4] residual colour and alpha; alpha is 0 where texels have none.
    """
    assert scene.atlas is not None
    _, height, width, _ = scene.atlas.shape
    (low_u, high_u, fu), (low_v, high_v, fv) = (
        _between(at, tiles[:, 3 + i], tiles[:, i]) for i, at in enumerate((u, v))
    )
    layer = tiles[:, 2, None, None] * height
    texels = scene.atlas.view(-1, 4)
    unit = 255.0 if texels.dtype == torch.uint8 else 1.0
    scale, offset = torch.tensor([[scene.scale] * 3 + [scene.alpha_scale], [scene.offset] * 3 + [0.0]])

    def fetch(x: Tensor, y: Tensor) -> Tensor:
        return texels[(layer + y[:, :, None]) * width + x[:, None]].float() / unit * scale + offset

    fu, fv = fu[:, None, :, None], fv[:, :, None, None]
    top = fetch(low_u, low_v) * (1 - fu) + fetch(high_u, low_v) * fu
    bottom = fetch(low_u, high_v) * (1 - fu) + fetch(high_u, high_v) * fu
    return top * (1 - fv) + bottom * fv


def _between(at: Tensor, count: Tensor, first: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The texels on both sides of positions [n, r] from -1 to 1 along an axis, and how far they are to the second."""
    last = (count - 1)[:, None]
    x = ((0.5 * (at + 1.0)) * count[:, None] - 0.5).clamp(min=0.0)
    x = torch.minimum(x, last.to(x))
    low = x.floor().long()
    return low + first[:, None], torch.minimum(low + 1, last) + first[:, None], x - low
