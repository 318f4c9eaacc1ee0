"""Drawing a baked scene with the CUDA kernels: textures, working memory and the call itself. Forward only."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from .backend import function, module, require
from .view_color import LEAN, check_lean, check_view_color
from .view_kinds import VIEW_COLORS

IMAGES: dict[str, tuple[int, torch.dtype]] = {
    "rgb": (3, torch.float32),
    "alpha": (1, torch.float32),
    "packed": (1, torch.int32),
    "beta": (1, torch.float32),
    "depth": (1, torch.float32),
    "normal": (3, torch.float32),
    "overdraw": (1, torch.int32),
}
"""Channels and dtype of what can be drawn. packed: red, green, blue and alpha as bytes, red the lowest."""

ON_CPU = "move the scene there, or draw with `baked_cpu.draw`"


class Stage(IntFlag):
    """Stages of a frame, for timing them apart; each needs what the ones before it left in the working memory."""

    PREPARE = 1
    BIN = 2
    DRAW = 4
    ALL = 7


class AtlasTexture:
    """The pages of an atlas in the memory of a device, as its texture unit reads them.

    Args:
        texels: [layers, height, width, 4] uint8, or float16 or float32 (stored as float16); or BC7 blocks
            [layers, height / 4, width / 4, 16] uint8. On the CPU.
        blocks: `texels` are BC7 blocks.
        device: where the surfels are.

    Raises:
        RuntimeError: the device has too little memory, refuses textures of this size, or is no CUDA device.
    """

    def __init__(self, texels: Tensor, blocks: bool, device: torch.device) -> None:
        require("baked.AtlasTexture", "cuda", device, ON_CPU)
        texels = texels.detach().cpu()
        layers, height, width = texels.shape[:3]
        if blocks:
            name, height, width = "bc7", 4 * height, 4 * width
        elif texels.dtype == torch.uint8:
            name = "uint8"
        else:
            name, texels = "half", texels.half()
        make = module(device).AtlasTexture
        data = texels.contiguous().view(torch.uint8)
        if device.type == "cuda":
            with torch.cuda.device(device):
                self._texture = make(name, layers, height, width, data)
        else:
            self._texture = make(name, layers, height, width, data)
        # handles are 64 bits without a sign
        self.pages = torch.tensor([h - (1 << 64) if h >> 63 else h for h in self._texture.handles], device=device)


@dataclass(frozen=True)
class BakedArrays:
    """What the kernels read of a baked scene; all on one device, float32 and int32, contiguous.

    Attributes:
        surfels: means [N, 3], quats [N, 4], log_scales [N, 2], opacity_logits [N], beta_raw [N] and the parameters of
            the view colour (ops.VIEW_COLORS, or ops.view_color.LEAN).
        view_color: a name of `ops.VIEW_COLORS`.
        tiles: [N, 5] int32: x, y, page, r_u, r_v in texels; r_u = 0: no tile.
        texture: the atlas, None = no tiles.
        offset, scale: residual = offset + scale * texel, texels of uint8 and BC7 in [0, 1].
        extent: [N] half side of the tile in scale units, None = 3.
        mean_residual: [N, 3] residual of surfels without a tile, None = 0.
        near: nearest depth that is drawn, camera z.
        weight_bound: fragments of smaller blending weight get no residual.
        through_pixel: the kernel is seen through a pixel, as in `Projection`.
        transmittance_min: a surfel that would leave a pixel less transmittance is not blended and ends the pixel.
    """

    surfels: Mapping[str, Tensor]
    view_color: str
    tiles: Tensor
    texture: AtlasTexture | None
    offset: float
    scale: float
    extent: Tensor | None
    mean_residual: Tensor | None
    near: float
    weight_bound: float
    through_pixel: bool
    transmittance_min: float

    def __post_init__(self) -> None:
        for name, value in self.surfels.items():
            if value.dtype != torch.float32 and name != "view_span":
                raise TypeError(f"the CUDA renderer takes float32 surfels, but {name} is {value.dtype}")
        check = check_lean if "view_terms" in self.surfels else check_view_color
        check(self.view_color, self.surfels, len(self.tiles))

    @property
    def device(self) -> torch.device:
        """Where the scene is."""
        return self.tiles.device

    @cached_property
    def arguments(self) -> tuple[Any, ...]:
        """The scene as the kernel takes it; kept, so that a recorded CUDA graph never points at memory that is gone."""
        p = {name: value.detach().contiguous() for name, value in self.surfels.items()}
        terms, full, lean = 0, (None, None, None), (None, None, None)
        if "view_terms" in p:
            lean = tuple(p[name] for name in LEAN)
        else:
            entry = VIEW_COLORS[self.view_color]
            terms, full = entry.terms(p), (*entry.of(p), None)[:3]
        geometry = (p["means"], p["quats"], p["log_scales"], p["opacity_logits"], p["beta_raw"])
        pages = None if self.texture is None else self.texture.pages
        optional = [None if t is None else t.detach().float().contiguous() for t in (self.extent, self.mean_residual)]
        fixed = (self.offset, self.scale, self.weight_bound, self.near, self.through_pixel, self.transmittance_min)
        return (*geometry, self.view_color, terms, *full, *lean, self.tiles.contiguous(), *optional, pages, *fixed)


@dataclass
class Workspace:
    """Working memory of frames on a device; it grows when a frame is prepared that needs more, and stays.

    Attributes:
        capacity: pairs of surfel and tile that fit.
    """

    capacity: int = 0
    memory: Tensor | None = field(default=None, repr=False)

    def fit(self, arrays: BakedArrays, views: int, width: int, height: int, normals: bool, capacity: int = 0) -> None:
        """Makes room for frames of this kind with at least `capacity` pairs, or as many as `settle` found.

        Raises:
            ValueError: more surfels, views or pairs than a frame can have; the message gives the numbers.
            RuntimeError: the scene is not on a CUDA device.
        """
        require("baked.Workspace.fit", "cuda", arrays.device, ON_CPU)
        kernels, device = module(arrays.device), arrays.device
        most = kernels.MOST_PAIRS
        if capacity > most:
            raise ValueError(f"the view needs {capacity} pairs of surfel and tile, a frame can have {most}")
        n = len(arrays.tiles)
        self.capacity = max(self.capacity, capacity) or min(most, 4 * n * views)
        sizes = (n, views, width, height, self.capacity, normals)
        if device.type == "cuda":
            with torch.cuda.device(device):
                needed = kernels.baked_memory(*sizes)
        else:
            needed = kernels.baked_memory(*sizes)
        if self.memory is None or self.memory.numel() < needed or self.memory.device != device:
            self.memory = None  # frees the old before the new is taken
            self.memory = torch.empty(needed, dtype=torch.uint8, device=device)

    @property
    def pairs(self) -> int:
        """Pairs of surfel and tile in the latest frame, which had surfels; waits for the device."""
        assert self.memory is not None
        return int(self.memory[:8].view(torch.int64))

    def settle(self) -> bool:
        """Whether the latest frame fitted; the next `fit` makes room for as many pairs and a quarter more, not for more
        than that, since the sort runs over the whole capacity. Waits for the device."""
        pairs = self.pairs
        fitted = pairs <= self.capacity
        self.capacity = pairs + pairs // 4 + 1
        return fitted


class WorkspacePool:
    """Working memory that is kept from frame to frame; one is used by one thread at a time."""

    def __init__(self) -> None:
        self._idle: list[Workspace] = []
        self._lock = threading.Lock()

    def take(self) -> Workspace:
        """An idle workspace, or a new one."""
        with self._lock:
            return self._idle.pop() if self._idle else Workspace()

    def give(self, workspace: Workspace) -> None:
        """Puts one back whose frame has been drawn."""
        with self._lock:
            self._idle.append(workspace)


def empty_images(
    names: tuple[str, ...], views: int, width: int, height: int, device: torch.device
) -> dict[str, Tensor]:
    """Memory for images: name -> [views, height, width, channels] (IMAGES)."""
    unknown = [name for name in names if name not in IMAGES]
    if unknown:
        raise ValueError(f"there is no image '{unknown[0]}': choose among {', '.join(IMAGES)}")
    return {
        name: torch.empty(views, height, width, IMAGES[name][0], dtype=IMAGES[name][1], device=device) for name in names
    }


def draw(
    arrays: BakedArrays,
    viewmats: Tensor,
    Ks: Tensor,
    background: Tensor | None,
    images: Mapping[str, Tensor],
    workspace: Workspace,
    stages: Stage = Stage.ALL,
) -> None:
    """Draws views into `images`. Allocates nothing and does not wait: it can be recorded in a CUDA graph.

    When more pairs were needed than the workspace has room for, surfels are missing: compare `workspace.pairs` with
    `workspace.capacity`, `fit` and draw again.

    Args:
        arrays: the scene.
        viewmats: [V, 4, 4] float32, world to camera, on the scene's device.
        Ks: [V, 3, 3] float32, likewise.
        background: [3] float32, likewise; None = black.
        images: what to draw, as `empty_images` makes them.
        workspace: fitted to such a frame.
        stages: the stages to run.

    Raises:
        ValueError: a shape is wrong, or the workspace is too small.
        RuntimeError: the scene is not on a CUDA device.
    """
    require("baked.draw", "cuda", arrays.device, ON_CPU)
    _, height, width, _ = next(iter(images.values())).shape
    assert workspace.memory is not None
    function("baked_frame", arrays.device)(
        *arrays.arguments,
        viewmats,
        Ks,
        width,
        height,
        background,
        *(images.get(name) for name in IMAGES),
        int(stages),
        workspace.memory,
        workspace.capacity,
    )
