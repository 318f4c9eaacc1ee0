"""Baked scenes in the form that the CUDA kernels read: textures of the atlas, arrays of the surfels."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .backend import function, lookup, on_device
from .baked_scene import LEVELS, BakedSceneLike, decode_bc7, residual
from .parameters import GEOMETRY
from .project import geometry_of
from .view_color import REDUCED, check_reduced, check_view_color, lettered
from .view_kinds import VIEW_COLORS


def draws_blocks(device: torch.device) -> bool:
    """Return True if a CUDA device's texture unit decodes BC7 blocks, tested by drawing some."""
    with on_device(device):
        return lookup("draws_bc7", device)()


def decoded(blocks: Tensor) -> Tensor:
    """Decode BC7 blocks [layers, height / 4, width / 4, 16] uint8 to texels [layers, height, width, 4] on the CPU."""
    height, width = 4 * blocks.shape[1], 4 * blocks.shape[2]
    pages = [decode_bc7(bytes(page.contiguous().numpy()), width, height) for page in blocks.cpu()]
    return torch.from_numpy(np.stack(pages))


class Sheet(NamedTuple):
    """Layout of the pages of an atlas in one texture: columns of pages."""

    down: int  # pages per column
    # width, height: pitch of the pages, in texels of the atlas
    width: int
    height: int

    @classmethod
    def of(cls, pages: int, height: int, width: int) -> Sheet:
        """Lay out pages of equal size in columns of up to 2^14 rows, which every texture format allows and which
        keeps the texture unit's fractional bits of coordinates."""
        height, width = -(-height // 4) * 4, -(-width // 4) * 4  # corners on the grid of the coarsest level
        return cls(max(1, min(pages, 2**14 // height)), width, height)

    def joined(self, pages: Tensor, side: int) -> Tensor:
        """Join pages [pages, rows, columns, channels] of texels, or of blocks of `side` texels, to one [rows, columns,
        channels]."""
        height, width = self.height // side, self.width // side
        count, rows, columns, channels = pages.shape
        beside = max(1, -(-count // self.down))
        if beside == 1 and (rows, columns) == (height, width):
            return pages.reshape(count * height, width, channels)
        sheet = pages.new_zeros(beside, self.down, height, width, channels)
        sheet.view(-1, height, width, channels)[:count, :rows, :columns] = pages
        return sheet.permute(1, 2, 0, 3, 4).reshape(self.down * height, beside * width, channels)


class AtlasTexture:
    """A texture with the texels of a sheet, on the CPU: [height, width, 4] uint8, or float16 or float32 (stored as
    float16); or, if `blocks`, BC7 blocks [height / 4, width / 4, 16] uint8. Raises ValueError: more texels than a
    texture can have. Raises RuntimeError: not enough memory, or BC7 is not supported."""

    def __init__(self, texels: Tensor, blocks: bool, device: torch.device) -> None:
        side, self._device = 4 if blocks else 1, device
        self.size = (side * texels.shape[0], side * texels.shape[1])  # height and width in texels
        self._bytes = texels.dtype == torch.uint8
        stored = texels if self._bytes else texels.half()
        name = "bc7" if blocks else "uint8" if self._bytes else "half"
        height, width = self.size
        with on_device(device):
            self.texture = lookup("AtlasTexture", device)(
                format=name, texels=stored.contiguous().view(torch.uint8), height=height, width=width
            )

    def halved(self, alpha: bool) -> AtlasTexture:
        """Return a texture of half the sides, averaging 2 x 2 texels on the device like `baked_scene.halved`."""
        height, width = (side // 2 for side in self.size)
        dtype = torch.uint8 if self._bytes else torch.float32
        texels = torch.empty(height, width, 4, dtype=dtype, device=self._device)
        halve = function("halve_texels_uint8" if self._bytes else "halve_texels_half", self._device)
        halve(texture=self.texture, height=height, width=width, alpha=alpha, texels=texels)
        return AtlasTexture(texels.cpu(), False, self._device)


class Atlas(NamedTuple):
    """Pages of an atlas on a device."""

    sheet: Sheet  # arrangement of the pages
    texture: AtlasTexture

    @classmethod
    def of(cls, pages: Tensor, blocks: bool, device: torch.device) -> Atlas:
        """Upload pages [pages, height, width, 4] of texels, or [pages, height / 4, width / 4, 16] of BC7 blocks if
        `blocks`, which are decoded, with a warning, if the device does not support them."""
        pages = pages.detach().cpu()
        if blocks and not draws_blocks(device):
            pages, blocks = decoded(pages), False
            told = f"the device '{device}' draws no BC7 textures: the atlas was decoded, at four times the memory"
            warnings.warn(told, stacklevel=2)
        side = 4 if blocks else 1
        count, height, width = pages.shape[:3]
        sheet = Sheet.of(count, side * height, side * width)
        return cls(sheet, AtlasTexture(sheet.joined(pages, side), blocks, device))

    def levels(self, alpha: bool) -> dict[str, AtlasTexture]:
        """Compute the coarser levels of the tiles by name (`tile_levels`)."""
        half = self.texture.halved(alpha)
        return dict(zip(LEVELS, (half, half.halved(alpha)), strict=True))


def compiled(scene: BakedSceneLike, photo_pixel: float = 1.0) -> Any:
    """Prepare a scene on a CUDA device for the kernels (`BakedScene` of csrc/cuda/baked.h), with its atlas as textures,
    for `photo_pixel` (`baked.draw`) below 1 also the levels of its tiles. The result keeps all memory it refers to
    alive, so that recorded CUDA graphs stay valid. Raises TypeError: the surfels are not float32. Raises ValueError: a
    parameter of the view colour has a wrong shape."""
    device = scene.tiles.device
    for name, value in scene.surfels.items():
        if value.dtype != torch.float32 and name != "view_span":
            raise TypeError(f"the CUDA renderer takes float32 surfels, but {name} is {value.dtype}")
    p = {name: value.detach().contiguous() for name, value in scene.surfels.items()}
    if "view_terms" in p:
        check_reduced(scene.view_color, p, len(scene.tiles))
        colors = dict(zip(("base", "span", "reduced"), (p[name] for name in REDUCED), strict=True))
    else:
        terms = check_view_color(scene.view_color, p, len(scene.tiles))
        colors = lettered(VIEW_COLORS[scene.view_color].of(p)) | {"terms": terms}
    texels = scene.atlas
    if scene.blocks is not None and (texels is None or draws_blocks(device)):
        texels = scene.blocks
    atlas = {}
    if texels is not None:
        is_blocks = texels is scene.blocks
        kept = scene.cache.atlas(lambda: Atlas.of(texels, is_blocks, device), texels, str(device))
        atlas = {"texture": kept.texture.texture, "pages_down": kept.sheet.down}
        atlas |= {"page_width": kept.sheet.width, "page_height": kept.sheet.height}
        if photo_pixel < 1.0:
            levels = scene.cache.coarser(lambda: kept.levels(scene.alpha_scale > 0))
            atlas |= {name: level.texture for name, level in levels.items()}
    with on_device(device):
        return lookup("BakedScene", device)(
            **dict(zip(GEOMETRY, geometry_of(p), strict=True)),
            **colors,
            **residual(scene),
            **atlas,
            kind=scene.view_color,
            tiles=scene.tiles.contiguous(),
            near=scene.near,
        )
