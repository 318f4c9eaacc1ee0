"""Baked scene: surfels and a texture atlas, no network; forward rendering only."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.ops.baked import DrawCache, common_size, draw, packed
from bitymi_ns.ops.capacity import memory_errors
from bitymi_ns.ops.constants import TRANSMITTANCE_MIN
from .camera import Camera
from .sampling import TWO_SAMPLES, Sampling, averaged, padded, part_of, sampling_of, size_of

FAST = 1 / 512  # transmittance at which fast rendering ends a pixel: at most half an 8-bit step is lost
OUTPUTS = ("rgb", "alpha", "beta", "depth", "normal", "overdraw")  # of a `BakedOutput`


def as_bytes(image: Tensor) -> Tensor:
    """Convert an image in [0, 1], clamped, to uint8 on the CPU."""
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu()


def image_names(maps: bool) -> tuple[str, ...]:
    """List the images to render for a `BakedOutput`."""
    return OUTPUTS if maps else OUTPUTS[:2]


@dataclass
class BakedOutput:
    """A rendered view of a baked scene; fields as in `scene.RenderOutput`, the last four with `maps`."""

    rgb: Tensor
    alpha: Tensor
    beta: Tensor | None = None
    depth: Tensor | None = None
    normal: Tensor | None = None
    overdraw: Tensor | None = None


@dataclass
class BakedScene:
    """A baked scene, content of a bundle, and its renderer on the CPU or a CUDA device.

    Attributes:
        surfels: per-surfel parameters by name (docs/overview.md), float32.
        view_color: a name of `ops.VIEW_COLORS`.
        tiles: [N, 5] int32: x, y, layer, r_u, r_v in texels; r_u = 0: no tile.
        atlas: [layers, height, width, 4] uint8 or float32, on the CPU, which a CUDA device draws as float16; None: no
            residual.
        blocks: [layers, height / 4, width / 4, 16] uint8 on the CPU, the same atlas as BC7 blocks, which a CUDA device
            reads; None: not given. The CPU needs `atlas`.
        offset, scale: residual = offset + scale * value, value = stored / 255 for uint8, stored for float32.
        extent: [N] half side of the tile in scale units; None: 3, the kernel's support.
        mean_residual: [N, 3] float32 mean residual of each tile, or residual without a tile; None: 0.
        alpha_scale: texels multiply their surfel's sigma by m = alpha_scale * value of their fourth channel
            (`ops.TexelAlpha`); 0: opaque texels.
        mean_alpha: [N] float32 mean m of each tile, or m without a tile; None: 1.
        near: near plane, camera z.
        weight_bound: fragments of smaller blending weight have no residual.
        transmittance_min: a pixel ends at the surfel, not blended itself, that would leave less transmittance; 0: no
            limit. Training uses 1e-4, and WebGPU always.
        photographed: [P, 4] float32 on the CPU, points of the scene and their resolution in the photographs, pixels per
            world unit, for the sampling of a view (`sampling.py`); None: as at the photographs' scale.
        through_webgpu: render through WebGPU (`ops.webgpu`), to the CPU.
    """

    surfels: Mapping[str, Tensor]
    view_color: str
    tiles: Tensor
    atlas: Tensor | None = None
    offset: float = 0.0
    scale: float = 1.0
    extent: Tensor | None = None
    mean_residual: Tensor | None = None
    alpha_scale: float = 0.0
    mean_alpha: Tensor | None = None
    near: float = 0.2
    weight_bound: float = 0.0
    transmittance_min: float = TRANSMITTANCE_MIN
    blocks: Tensor | None = None
    photographed: Tensor | None = None
    through_webgpu: bool = False
    cache: DrawCache = field(default_factory=DrawCache, init=False, repr=False, compare=False)

    def residuals(self) -> Tensor:
        """Compute the residual colours of the atlas, [layers, height, width, 3] float32. Raises ValueError: there is
        none, or only its BC7 blocks."""
        return self._values(slice(3)) * self.scale + self.offset

    def alphas(self) -> Tensor | None:
        """Compute the atlas's factors m of sigma, [layers, height, width] float32; None: no atlas, or opaque texels.
        Raises ValueError: there are only the atlas's BC7 blocks."""
        if not self.alpha_scale or (self.atlas is None and self.blocks is None):
            return None
        return self._values(3) * self.alpha_scale

    def _values(self, channels: int | slice) -> Tensor:
        """Read channels of the atlas as float32, uint8 scaled to [0, 1]."""
        if self.atlas is None:
            raise ValueError("the scene has no atlas" if self.blocks is None else "the atlas was not decoded")
        values = self.atlas[..., channels].float()
        return values / 255.0 if self.atlas.dtype == torch.uint8 else values

    def to(self, device: torch.device | str) -> BakedScene:
        """Move the surfels to a device; the first render uploads the texels."""
        return self._changed(lambda name, value: value.to(device))

    def only(self, kept: Tensor) -> BakedScene:
        """Keep the surfels for which `kept` [N] is True; texels and terms of view colours stay."""
        return self._changed(lambda name, value: value if name == "view_terms" else value[kept.to(value.device)])

    def _changed(self, change: Callable[[str, Tensor], Tensor]) -> BakedScene:
        """Change the surfels' arrays, given their names."""
        surfels = {name: change(name, value) for name, value in self.surfels.items()}
        arrays = {name: getattr(self, name) for name in ("tiles", "extent", "mean_residual", "mean_alpha")}
        arrays = {name: change(name, value) for name, value in arrays.items() if value is not None}
        return replace(self, surfels=surfels, **arrays)

    def __len__(self) -> int:
        return len(self.tiles)

    @torch.no_grad()
    @memory_errors()
    def render(self, camera: Camera, background: Tensor | None = None, maps: bool = False) -> BakedOutput:
        """Render a view. Texels are fetched bilinearly, clamped to the tile's outer texel centres. Samples per pixel
        follow the scale of the view (`sampling`); overdraw is the sum over the samples of a pixel.

        On a CUDA device this allocates its images and synchronises; `SceneRenderer` keeps memory and CUDA graphs.

        Args:
            background: [3] colour behind the scene; None: black.
            maps: also render beta, depth, normals and overdraw.

        Raises:
            ValueError: the scene is on the CPU and has only the atlas's BC7 blocks.
        """
        images = self._draw([camera], background, image_names(maps))
        return BakedOutput(**{name: image[0] for name, image in images.items()})

    @torch.no_grad()
    def render_views(
        self, cameras: Sequence[Camera], background: Tensor | None = None, images: Sequence[str] = ("rgb", "alpha")
    ) -> dict[str, Tensor]:
        """Render at least one view, all of one size, in a batch on a CUDA device, with the same samples per pixel.

        Arguments and images are those of `ops.baked.draw`.

        Raises:
            ValueError: the cameras differ in size or have skew, or views times surfels is above 2^24.
            RuntimeError: the scene is on the CPU; or the device has too little memory.
        """
        if not cuda_backend(self.tiles.device):
            raise RuntimeError("only a CUDA device draws views together: move the scene there, or render one by one")
        return self._draw(cameras, background, images)

    def sampling(self, cameras: Sequence[Camera]) -> Sampling:
        """Choose the sampling of views by the geometric mean of their scales."""
        if self.photographed is None or not len(self.photographed):
            return Sampling()
        size = math.exp(sum(math.log(size_of(self.photographed, camera)) for camera in cameras) / len(cameras))
        if size >= TWO_SAMPLES:
            return sampling_of(size, cameras[0].width * cameras[0].height)
        device = self.tiles.device
        left, top, right, bottom = part = part_of(self.surfels, [camera.to(device) for camera in cameras], self.near)
        return replace(sampling_of(size, (right - left) * (bottom - top)), part=part)

    def _draw(self, cameras: Sequence[Camera], background: Tensor | None, images: Sequence[str]) -> dict[str, Tensor]:
        """Render at the sampling of the views."""
        common_size(cameras)
        sampling = self.sampling(cameras)
        if sampling.samples == 1:
            return draw(self, cameras, background, images, sampling.photo_pixel)
        names = [name for name in images if name != "packed"]
        if "packed" in images:  # bytes cannot be averaged
            names += [name for name in ("rgb", "alpha") if name not in names]
        left, top, right, bottom = sampling.part or (0, 0, cameras[0].width, cameras[0].height)
        views = [camera.part(left, top, right, bottom).scaled(sampling.samples) for camera in cameras]
        drawn = averaged(draw(self, views, background, names, sampling.photo_pixel), sampling.samples)
        if sampling.part is not None:
            around = {"rgb": background} if background is not None else {}
            size = cameras[0].height, cameras[0].width
            drawn = {name: padded(image, sampling.part, size, around.get(name)) for name, image in drawn.items()}
        if "packed" in images:
            drawn["packed"] = packed(drawn["rgb"], drawn["alpha"])
        return {name: drawn[name] for name in images}
