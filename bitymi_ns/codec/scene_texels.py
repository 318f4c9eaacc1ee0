"""Texels of a baked scene as a list, in the order of `ops.TexelTiles`."""

import torch
from torch import Tensor

from bitymi_ns.codec.packing import Packing
from bitymi_ns.codec.pages import listed_texels
from bitymi_ns.ops import TexelAlpha, TexelTiles
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.baked import BakedScene


def scene_texels(scene: BakedScene) -> Tensor:
    """[T, 3] residual colours of a scene on the CPU; a surfel without a tile has one, its mean residual."""
    assert scene.mean_residual is not None
    if scene.atlas is None and scene.blocks is None:
        return scene.mean_residual
    return _listed(scene, scene.residuals(), scene.mean_residual)


def texel_alpha(scene: BakedScene) -> TexelAlpha | None:
    """Alpha texels of a scene for its projections, on its device; a surfel without a tile has one, its mean alpha.
    None = the scene has no alpha.

    Raises:
        ValueError: the atlas is only there as BC7 blocks.
    """
    alphas, device = scene.alphas(), scene.tiles.device
    if alphas is None and scene.mean_alpha is None:
        return None
    means = torch.ones(len(scene)) if scene.mean_alpha is None else scene.mean_alpha.cpu()
    extent = torch.full_like(means, SUPPORT, device=device) if scene.extent is None else scene.extent.float()
    if alphas is None:  # without an atlas every surfel has its constant
        sizes, values = torch.ones_like(scene.tiles[:, 3:]), means
    else:
        sizes, values = scene.tiles[:, 3:].clamp(min=1), _listed(scene, alphas[..., None], means[:, None])[:, 0]
    return TexelAlpha(TexelTiles.of_sizes(sizes, extent), values.contiguous().to(device), scene.weight_bound)


def _listed(scene: BakedScene, pages: Tensor, constants: Tensor) -> Tensor:
    layers, height, width = pages.shape[:3]
    return listed_texels(pages, Packing(scene.tiles.cpu().numpy(), width, height, layers, 1.0), constants)
