"""Images of a baked scene, and what its renderers share."""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from .backend import Pool, version_of
from .project import CameraLike, refuse_skew

IMAGES: dict[str, tuple[int, torch.dtype]] = {
    "rgb": (3, torch.float32),
    "alpha": (1, torch.float32),
    "packed": (1, torch.int32),
    "beta": (1, torch.float32),
    "depth": (1, torch.float32),
    "normal": (3, torch.float32),
    "overdraw": (1, torch.int32),
}
"""Channels and dtype of each image. packed (CUDA only): red, green, blue and alpha as bytes, red lowest."""


class DrawCache:
    """Data of a scene kept between frames: the atlas in device form, and working memory. Thread-safe, as nerfstudio's
    viewer renders from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: tuple[Tensor | str | None, ...] = ()
        self._key: list[Any] = []
        self._atlas: Any = None
        self._coarser: Any = None
        self._workspaces: Pool[Any] | None = None

    def __reduce__(self) -> tuple[type, tuple[()]]:
        """Pickle and copy as an empty cache: its contents belong to one process."""
        return DrawCache, ()

    def atlas(self, make: Callable[[], Any], *sources: Tensor | str | None) -> Any:
        """Return the atlas, made anew when a source was replaced or written to."""
        key = [(id(t), version_of(t)) if isinstance(t, Tensor) else t for t in sources]
        with self._lock:
            if key != self._key:
                self._atlas, self._coarser, self._key = make(), None, key
                self._sources = sources  # kept, so that no other tensor gets an id of the key
            return self._atlas

    def coarser(self, make: Callable[[], Any]) -> Any:
        """Return the coarser levels of the latest `atlas`, made for the first frame that needs them."""
        with self._lock:
            if self._coarser is None:
                self._coarser = make()
            return self._coarser

    def workspaces(self, make: Callable[[], Any]) -> Pool[Any]:
        """Return the pool of working memory that `make` constructs."""
        with self._lock:
            if self._workspaces is None:
                self._workspaces = Pool(make)
            return self._workspaces


class BakedSceneLike(Protocol):
    """A baked scene; `scene.baked.BakedScene` documents its attributes."""

    surfels: Mapping[str, Tensor]
    view_color: str
    tiles: Tensor
    atlas: Tensor | None
    blocks: Tensor | None
    offset: float
    scale: float
    extent: Tensor | None
    mean_residual: Tensor | None
    alpha_scale: float
    mean_alpha: Tensor | None
    near: float
    weight_bound: float
    transmittance_min: float
    through_webgpu: bool
    cache: DrawCache


def residual(scene: BakedSceneLike) -> dict[str, Any]:
    """Build the kernels' arguments for texels (`BakedResidual` of csrc/ops/texel.h)."""
    numbers = ("offset", "scale", "alpha_scale", "weight_bound", "transmittance_min")
    arrays = {name: getattr(scene, name) for name in ("extent", "mean_residual", "mean_alpha")}
    dense = {name: None if t is None else t.detach().float().contiguous() for name, t in arrays.items()}
    return {name: getattr(scene, name) for name in numbers} | dense


def check_images(names: Sequence[str], on_cuda: bool) -> None:
    """Raise ValueError for an image that does not exist or needs a CUDA device."""
    unknown = [name for name in names if name not in IMAGES]
    if unknown:
        raise ValueError(f"there is no image '{unknown[0]}': choose among {', '.join(IMAGES)}")
    if "packed" in names and not on_cuda:
        raise ValueError("the image 'packed' is drawn on a CUDA device only: draw rgb and alpha")


def packed(rgb: Tensor, alpha: Tensor) -> Tensor:
    """Convert images rgb [..., 3] and alpha [..., 1] to packed, [..., 1] int32."""
    byte = (torch.cat([rgb, alpha], -1).clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.int32)
    return byte[..., :1] | byte[..., 1:2] << 8 | byte[..., 2:3] << 16 | byte[..., 3:] << 24


def common_size(cameras: Sequence[CameraLike]) -> tuple[int, int]:
    """Return the common width and height of views. Raises ValueError: no views, different sizes, or skew."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"views that are drawn together need one size, not {sorted(sizes)}")
    for camera in cameras:
        refuse_skew(camera)
    return sizes.pop()


LEVELS = ("half", "quarter")  # names of the levels, by their side relative to the atlas


def halved(atlas: Tensor, alpha: bool = False) -> Tensor:
    """Average 2 x 2 texels: [layers, height, width, 4] to [layers, height / 2, width / 2, 4], bytes rounded, an odd row
    or column dropped. With `alpha` as `alpha_means`: transparent texels do not tint their neighbours."""
    height, width = atlas.shape[1] // 2 * 2, atlas.shape[2] // 2 * 2
    # stacked, as torch reduces the outermost dimension several times as fast as inner ones
    four = torch.stack([atlas[:, i:height:2, j:width:2] for i in (0, 1) for j in (0, 1)])
    if atlas.dtype == torch.uint8:
        summed = four.to(torch.int32)
        means = (summed.sum(0, dtype=torch.int32) + 2) >> 2
        if alpha:
            weight = summed[..., 3:]
            total = weight.sum(0, dtype=torch.int32)
            colors = ((weight * summed[..., :3]).sum(0, dtype=torch.int32) + (total >> 1)) // total.clamp(min=1)
            means[..., :3] = torch.where(total > 0, colors, means[..., :3])
        return means.to(torch.uint8)
    return alpha_means(four, 0) if alpha else four.mean(0)


def alpha_means(texels: Tensor, dims: int | tuple[int, ...]) -> Tensor:
    """Average texels [..., 4] over dimensions; colours are weighted by alpha (fourth channel) unless it is all 0."""
    means, alpha = texels.mean(dims), texels[..., 3:]
    total = alpha.sum(dims)
    colors = (alpha * texels[..., :3]).sum(dims) / total.clamp(min=1e-6)
    means[..., :3] = torch.where(total > 0, colors, means[..., :3])
    return means


def tile_levels(atlas: Tensor, tiles: Tensor, alpha: bool = False) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield the coarser levels of an atlas, finest first.

    Args:
        atlas: [layers, height, width, 4] uint8 or float.
        tiles: [N, 5] int32: x, y, layer, r_u, r_v in texels.
        alpha: as in `halved`.

    Yields:
        name, pages, and the tiles on them; r_u = 0 for a tile whose corner or sides are off the level's grid. Tiles of
        bundles, on a grid of four texels, have both levels.
    """
    scaled = tiles.new_tensor([1, 1, 0, 1, 1])
    for level, name in enumerate(LEVELS, start=1):
        atlas = halved(atlas, alpha)
        if 0 in atlas.shape:
            return
        fits = (tiles * scaled % (1 << level) == 0).all(1, keepdim=True)
        yield name, atlas.contiguous(), torch.where(fits, tiles >> (level * scaled), 0).contiguous()


def decode_bc7(blocks: bytes, width: int, height: int) -> npt.NDArray[np.uint8]:
    """Decode row-major BC7 blocks to texels [height, width, 4] on the CPU; sides are multiples of 4."""
    return np.array(Image.frombytes("RGBA", (width, height), blocks, "bcn", (7, "BC7")))
