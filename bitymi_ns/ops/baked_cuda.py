"""Rendering of baked scenes with the CUDA kernels: textures, working memory, kernel calls."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .backend import function, lookup, module, on_device
from .baked_scene import IMAGES, LEVELS, BakedSceneLike, check_images, common_size, decode_bc7, residual
from .constants import TILE
from .parameters import GEOMETRY
from .project import CameraLike, geometry_of
from .view_color import REDUCED, check_reduced, check_view_color, lettered
from .view_kinds import VIEW_COLORS


class Stage(IntFlag):
    """Stages of a frame, for timing; each needs the results of the previous ones in the working memory."""

    LIST = 1
    DRAW = 2
    ALL = 3


def draws_blocks(device: torch.device) -> bool:
    """Return True if the texture unit of a CUDA device decodes BC7 blocks, tested by drawing some."""
    with on_device(device):
        return lookup("draws_bc7", device)()


def decoded(blocks: Tensor) -> Tensor:
    """Decode BC7 blocks [layers, height / 4, width / 4, 16] uint8 to texels [layers, height, width, 4] uint8 on the
    CPU."""
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
        """Lay out pages of equal size in columns of up to 2^14 rows: every texture format allows that many, and
        coordinates keep the texture unit's fractional bits."""
        height, width = -(-height // 4) * 4, -(-width // 4) * 4  # corners on the grid of the coarsest level
        return cls(max(1, min(pages, 2**14 // height)), width, height)

    def joined(self, pages: Tensor, side: int) -> Tensor:
        """Join pages [pages, rows, columns, channels] of texels, or of blocks with `side` texels along a side, to one
        [rows, columns, channels]."""
        height, width = self.height // side, self.width // side
        count, rows, columns, channels = pages.shape
        beside = max(1, -(-count // self.down))
        if beside == 1 and (rows, columns) == (height, width):
            return pages.reshape(count * height, width, channels)
        sheet = pages.new_zeros(beside, self.down, height, width, channels)
        sheet.view(-1, height, width, channels)[:count, :rows, :columns] = pages
        return sheet.permute(1, 2, 0, 3, 4).reshape(self.down * height, beside * width, channels)


class AtlasTexture:
    """A texture with the texels of a sheet.

    Args:
        texels: [height, width, 4] uint8, or float16 or float32 (stored as float16); or BC7 blocks
            [height / 4, width / 4, 16] uint8. On the CPU.
        blocks: whether `texels` are BC7 blocks.

    Raises:
        ValueError: more texels than a texture can have.
        RuntimeError: not enough memory, or BC7 is not supported.
    """

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
        """Return a texture of half the sides, averaging 2 x 2 texels like `baked_scene.halved`; computed on the device,
        which decodes BC7 while sampling."""
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
        """Upload pages. `pages`: [pages, height, width, 4] texels, or BC7 blocks [pages, height / 4, width / 4, 16], as
        `AtlasTexture` takes them. `blocks`: whether they are BC7 blocks; decoded, with a warning, if the device does
        not support them."""
        pages = pages.detach().cpu()
        if blocks and not draws_blocks(device):
            pages, blocks = decoded(pages), False
            warnings.warn(
                f"the device '{device}' draws no BC7 textures: the atlas was decoded, at four times the memory",
                stacklevel=2,
            )
        side = 4 if blocks else 1
        count, height, width = pages.shape[:3]
        sheet = Sheet.of(count, side * height, side * width)
        return cls(sheet, AtlasTexture(sheet.joined(pages, side), blocks, device))

    def levels(self, alpha: bool) -> dict[str, AtlasTexture]:
        """Compute the coarser levels of the tiles, with or without alpha, by name (`tile_levels`)."""
        half = self.texture.halved(alpha)
        return dict(zip(LEVELS, (half, half.halved(alpha)), strict=True))


def compiled(scene: BakedSceneLike, photo_pixel: float = 1.0) -> Any:
    """Prepare the scene for the kernels (`BakedScene` of csrc/cuda/baked.h), with its atlas as textures. The result
    keeps all memory it refers to alive, so that recorded CUDA graphs stay valid.

    Args:
        scene: on a CUDA device.
        photo_pixel: as in `frame`; below 1 the levels of the tiles are added.

    Raises:
        TypeError: the surfels are not float32.
        ValueError: a parameter of the view colour has a wrong shape.
    """
    device = scene.tiles.device
    for name, value in scene.surfels.items():
        if value.dtype != torch.float32 and name != "view_span":
            raise TypeError(f"the CUDA renderer takes float32 surfels, but {name} is {value.dtype}")
    p = {name: value.detach().contiguous() for name, value in scene.surfels.items()}
    if "view_terms" in p:
        check_reduced(scene.view_color, p, len(scene.tiles))
        colors = dict(zip(("base", "span", "lean"), (p[name] for name in REDUCED), strict=True))
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


def tiles_of(views: int, width: int, height: int) -> int:
    """Count the screen tiles of all views."""
    return -(-width // TILE) * -(-height // TILE) * views


def slots_per_tile(capacity: int, tiles: int) -> int:
    """Choose the slots for the pairs of each screen tile: twice the mean of `capacity` pairs, more if all fit in 32 MB,
    at most what a block of threads sorts at once. Further pairs share one list of all tiles."""
    return max(32, min(1024, max(2 * capacity, 1 << 23) // tiles) // 32 * 32)


class Workspace:
    """Working memory of frames on a device; it grows as needed and is kept.

    Attributes:
        capacity: pairs of surfel and screen tile that fit, for any distribution over the tiles.
        slots: per tile; 0 before the first frame.
        memory: [bytes] uint8; None before the first frame.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.capacity = self.slots = 0
        self.memory: Tensor | None = None

    def resize(self, surfels: int, views: int, width: int, height: int, normals: bool, capacity: int = 0) -> None:
        """Allocate for such frames with at least `capacity` pairs, or the number that `frame_fitted` found. Raises
        ValueError: more surfels, views or pairs than a frame can have; states the numbers."""
        kernels, device = module(self._device), self._device
        most = kernels.MOST_PAIRS
        if capacity > most:
            raise ValueError(f"the view needs {capacity} pairs of surfel and tile, a frame can have {most}")
        self.capacity = max(self.capacity, capacity) or min(most, 4 * surfels * views)
        self.slots = slots_per_tile(self.capacity, tiles_of(views, width, height))
        size = {"surfels": surfels, "views": views, "width": width, "height": height, "normals": normals}
        with on_device(device):
            needed = kernels.baked_memory(**size, slots=self.slots, capacity=self.capacity)
        if self.memory is None or self.memory.numel() < needed:
            self.memory = None  # frees the old memory first
            self.memory = torch.empty(needed, dtype=torch.uint8, device=device)

    def counts(self) -> tuple[int, int]:
        """Return the pairs of the latest non-empty frame, and those without a slot; waits for the device."""
        assert self.memory is not None
        pairs, spilled = self.memory[:16].view(torch.int64).tolist()
        return pairs, spilled

    @property
    def pairs(self) -> int:
        """Return the pairs of surfel and tile in the latest non-empty frame; waits for the device."""
        return self.counts()[0]

    @property
    def complete(self) -> bool:
        """True if all pairs of the latest non-empty frame fitted; waits for the device."""
        return self.counts()[1] <= self.capacity

    def frame_fitted(self) -> bool:
        """Return True if the latest frame fitted; waits for the device. The next `resize` allocates for its pairs
        and a quarter more."""
        pairs, spilled = self.counts()
        fitted = spilled <= self.capacity
        self.capacity = pairs + pairs // 4 + 1
        return fitted


def empty_images(names: Sequence[str], views: int, width: int, height: int, device: torch.device) -> dict[str, Tensor]:
    """Allocate images: name -> [views, height, width, channels] (IMAGES)."""
    check_images(names, on_cuda=True)
    shape = (views, height, width)
    return {name: torch.empty(*shape, IMAGES[name][0], dtype=IMAGES[name][1], device=device) for name in names}


def stack_cameras(cameras: Sequence[CameraLike], device: torch.device) -> tuple[Tensor, Tensor, int, int]:
    """Stack cameras of one size: viewmats [V, 4, 4] and Ks [V, 3, 3], float32 on `device`, width and height. Raises
    ValueError: no cameras, different sizes, or skew."""
    size = common_size(cameras)
    viewmats = torch.stack([camera.viewmat for camera in cameras]).to(device, torch.float32)
    Ks = torch.stack([camera.K for camera in cameras]).to(device, torch.float32)
    return viewmats, Ks, *size


def frame(
    scene: Any,  # from `compiled`
    viewmats: Tensor,
    Ks: Tensor,
    background: Tensor | None,
    images: Mapping[str, Tensor],
    workspace: Workspace,
    stages: Stage = Stage.ALL,
    photo_pixel: float = 1.0,
) -> None:
    """Draw views into `images` without allocating or waiting, so that it can be recorded in a CUDA graph.

    If the workspace is too small for the pairs, surfels are missing: check `workspace.complete`, `resize` and draw
    again.

    Args:
        viewmats: [V, 4, 4] float32, world to camera, on the scene's device.
        Ks: [V, 3, 3] float32, likewise.
        background: [3] float32, likewise; None: black.
        images: images to draw, from `empty_images`.
        workspace: resized for such a frame.
        photo_pixel: side of a photograph's pixel in pixels of the views.

    Raises:
        ValueError: wrong shape, or the workspace is too small.
    """
    _, height, width, _ = next(iter(images.values())).shape
    function("baked_frame", viewmats.device)(
        **images,
        scene=scene,
        viewmats=viewmats,
        Ks=Ks,
        width=width,
        height=height,
        background=background,
        stages=int(stages),
        photo_pixel=photo_pixel,
        memory=workspace.memory,
        slots=workspace.slots,
        capacity=workspace.capacity,
    )


def draw(
    scene: BakedSceneLike,
    cameras: Sequence[CameraLike],
    background: Tensor | None,
    images: Sequence[str],
    photo_pixel: float = 1.0,
) -> dict[str, Tensor]:
    """Draw views in one batch; see `baked.draw`. Waits for the images, to check that the working memory sufficed."""
    device, n = scene.tiles.device, len(scene.tiles)
    viewmats, Ks, width, height = stack_cameras(cameras, device)
    arrays = compiled(scene, photo_pixel)
    if background is not None:
        background = background.to(device, torch.float32).contiguous()
    to = empty_images(images, len(cameras), width, height, device)
    size = (n, len(cameras), width, height, "normal" in to)
    with scene.cache.workspaces(lambda: Workspace(device)).borrow() as workspace:
        while True:  # a second time if the pairs did not fit
            workspace.resize(*size)
            frame(arrays, viewmats, Ks, background, to, workspace, photo_pixel=photo_pixel)
            if n == 0 or workspace.frame_fitted():  # waits: the next frame may use the memory on another stream
                return to
