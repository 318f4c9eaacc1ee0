"""Scenes and error bounds for tests of the baked renderer."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from bitymi_ns.ops.baked_renderer import Workspace, tiles_of
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.sampling import averaged
from bitymi_ns.train.losses import psnr
from tests.bake.conftest import make_surfels
from tests.ops.golden import SceneCase

FLIP = 4 / 255
"""Bound of colour differences on a GPU: its special function unit is accurate to about 2^-21, so fragments of opacity
near 1/255 may be drawn there only, and colours are below 4."""


def camera_of(case: SceneCase) -> Camera:
    return Camera(case.viewmat.float(), case.K.float(), case.width, case.height)


def scene_of(case: SceneCase, **kwargs) -> BakedScene:
    params = {name: value.float() for name, value in case.params.items()}
    return BakedScene(params, "sv", torch.zeros(len(params["means"]), 5, dtype=torch.int32), None, **kwargs)


def textured(count: int, seed: int, dtype: torch.dtype = torch.uint8, kind: str = "sv") -> BakedScene:
    """Make surfels around the origin, two thirds with a tile of random texels, on two pages, with random extents."""
    g = torch.Generator().manual_seed(seed)
    atlas = torch.rand(2, 16, 16 * count, 4, generator=g)
    atlas = (atlas * 255).to(torch.uint8) if dtype == torch.uint8 else atlas
    i = torch.arange(count)
    sizes = 4 << torch.randint(0, 3, (count, 2), generator=g)
    tiles = torch.stack([16 * i, 0 * i, i % 2, *sizes.unbind(1)], dim=1)
    tiles[::3] = 0
    return BakedScene(
        make_surfels(count, kind, seed),
        kind,
        tiles.int(),
        atlas,
        offset=-0.4,
        scale=0.9,
        extent=1.5 + 2 * torch.rand(count, generator=g),
        mean_residual=0.5 * torch.randn(count, 3, generator=g) * (i % 2 == 0)[:, None],
        weight_bound=0.02,
    )


def cut_out(count: int, seed: int, dtype: torch.dtype = torch.uint8) -> BakedScene:
    """Make such surfels with alpha texels, a third of them 0, some 2, and constants between 0 and 2 without tiles."""
    scene, g = textured(count, seed, dtype), torch.Generator().manual_seed(seed)
    assert scene.atlas is not None
    m = (3 * torch.rand(scene.atlas.shape[:3], generator=g) - 1).clamp(0, 255 / 128)
    scene.atlas[..., 3] = (128 * m).round().to(torch.uint8) if dtype == torch.uint8 else m
    mean = (3 * torch.rand(count, generator=g) - 0.5).clamp(0, 2)
    return replace(scene, alpha_scale=255 / 128 if dtype == torch.uint8 else 1.0, mean_alpha=mean)


FAR = [(True, 0.25, 43.0), (True, 0.125, 47.0), (True, 0.0625, 52.0), (False, 0.25, 59.0), (False, 0.125, 60.0)]
FAR += [(False, 0.0625, 64.0)]
"""Alpha texels of `layered`, relative size of the view, and least PSNR there against the averaged full-size render."""


def layered(alpha: bool) -> tuple[BakedScene, Camera]:
    """Make four layers of a tilted wall of surfels, and the camera of the photographs. With `alpha`, texels of all
    layers are cut out along the same edges, finer than a pixel of a far view."""
    across, side, scale, tilt = 6, 16, 0.22, 0.5
    count = 4 * across**2
    scene, i = textured(count, 0), torch.arange(count)
    x, y = (1.6 * ((i % across + 0.5) / across * 2 - 1), 1.2 * ((i // across % across + 0.5) / across * 2 - 1))
    means = torch.stack([x, y, 0.01 * (i // across**2)], 1)
    surfels = {
        **scene.surfels,
        "means": means,
        "quats": torch.tensor([[math.cos(tilt / 2), 0, math.sin(tilt / 2), 0]]).repeat(count, 1),
        "log_scales": torch.full((count, 2), math.log(scale)),
        "opacity_logits": torch.full((count,), 1.5),
    }
    u = scale * (6 * (torch.arange(side) + 0.5) / side - 3)
    column, row = x[:, None] + math.cos(tilt) * u, y[:, None] + u  # [count, side] texel positions
    texels = torch.zeros(side, count, side, 4)
    texels[..., :3] = 0.5 + 0.4 * torch.sin(9 * column)[None, :, :, None]
    texels[..., 3] = torch.sin(18 * column) + torch.sin(15 * row).T[:, :, None] > 0
    camera = front(240, 176)
    lens = torch.tensor([4.0, 4, 1])[:, None]
    camera = replace(camera, K=torch.where(camera.K.diag().diag() > 0, lens * camera.K, camera.K))
    rate = math.sqrt(float(camera.K[0, 0] * camera.K[1, 1])) / float(camera.viewmat[2, 3])
    made = replace(
        scene,
        surfels=surfels,
        tiles=torch.stack([side * i, 0 * i, 0 * i, 0 * i + side, 0 * i + side], 1).int(),
        atlas=(255 * texels.reshape(1, side, side * count, 4)).round().to(torch.uint8),
        extent=None,
        mean_residual=torch.zeros(count, 3),
        mean_alpha=torch.ones(count),
        alpha_scale=255 / 128 if alpha else 0.0,
        photographed=torch.cat([means, torch.full((count, 1), rate)], 1),
    )
    return made, camera


def to_average(scene: BakedScene, camera: Camera, share: float) -> float:
    """Compute the PSNR of a view of relative size `share` against the averaged full-size view."""
    full = scene.render(camera).rgb
    return psnr(scene.render(camera.scaled(share)).rgb, averaged({"rgb": full[None]}, round(1 / share))["rgb"][0])


def front(width: int = 60, height: int = 44, distance: float = 4.0) -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    return Camera(viewmat, torch.tensor([[60.0, 0, width / 2], [0, 55.0, height / 2], [0, 0, 1]]), width, height)


def most(device: torch.device, emulated: float, card: float) -> float:
    return card if device.type == "cuda" else emulated


class ListedPairs(NamedTuple):
    """Lists of a frame."""

    ranges: Tensor  # [tiles, 2] begin and end of each screen tile's list, view by view
    depth: Tensor  # [surfels * views] depth keys, 2^32 - 1: not visible
    pairs: Tensor  # row << 8 | mask of the 8 x 4 parts of the tile, tile by tile

    @property
    def visible(self) -> Tensor:
        """Mask [surfels * views] of visible surfels."""
        return self.depth != 0xFFFFFFFF


def listed_pairs(workspace: Workspace, surfels: int, views: int, width: int, height: int) -> ListedPairs:
    """Read the lists of the latest frame (without normals) from the working memory (`lay_out` of
    csrc/cuda/baked_list.cu), to the CPU."""
    assert workspace.memory is not None
    memory, at = workspace.memory.cpu(), 256
    tiles, rows, slots = tiles_of(views, width, height), surfels * views, workspace.slots

    def take(count: int) -> Tensor:
        nonlocal at
        values = memory[at : at + 4 * count].view(torch.int32)
        at += -(-4 * count // 256) * 256
        return values

    lists = take(8 * tiles).view(tiles, 8).long() & 0xFFFFFFFF
    take(24 * rows)
    depth = take(rows).long() & 0xFFFFFFFF
    pairs = take(tiles * slots + workspace.capacity).long() & 0xFFFFFFFF
    counts, rest = torch.where(lists[:, 0] > slots, lists[:, 1], lists[:, 0]), lists[:, 2]
    ends = counts.cumsum(0)
    begins = ends - counts
    tile = torch.repeat_interleave(torch.arange(tiles), counts)
    index = torch.arange(len(tile)) - begins[tile]  # in the tile's list
    at_slot = index < slots
    return ListedPairs(
        torch.stack([begins, ends], dim=1), depth, pairs[index + torch.where(at_slot, tile * slots, rest[tile])]
    )
