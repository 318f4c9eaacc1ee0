"""A baked scene: surfels and an atlas, no network. Forward only, nothing here learns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns.ops import project, view_color
from bitymi_ns.ops.backend import module
from bitymi_ns.ops.trace import TRANSMITTANCE_MIN
from bitymi_ns.ops.trace_cpu import tracers

from .camera import Camera

if TYPE_CHECKING:
    from bitymi_ns.bake.bundle import Bundle


@dataclass
class BakedOutput:
    """A view of a baked scene; the fields mean what they mean in `scene.RenderOutput`."""

    rgb: Tensor
    alpha: Tensor
    beta: Tensor | None
    depth: Tensor | None
    normal: Tensor | None
    overdraw: Tensor | None


@dataclass
class BakedScene:
    """Renders a bundle.

    Attributes:
        surfels: per-surfel parameters by name (docs/architecture.md), float32.
        view_color: sv, sh, sb or sg.
        tiles: [N, 5] int32: x, y, layer, r_u, r_v in texels; r_u = 0: no tile.
        atlas: [layers, height, width, 4] uint8 or float32, None = no residual.
        offset, scale: residual = offset + scale * value, value = stored / 255 for uint8, stored for float32.
        extent: [N] half side of the tile in scale units, None = 3, the kernel's support, everywhere.
        mean_residual: [N, 3] float32 mean residual of every tile; a surfel without a tile has this residual. None = 0.
        near: nearest depth that is drawn, camera z.
        weight_bound: fragments of smaller blending weight keep the surfel's colour without the residual.
        prefilter: low_pass or pixel, as in `SceneConfig`.
        transmittance_min: a surfel that would leave a pixel less transmittance is not blended and ends the pixel, as in
            training; 0 = every surfel is blended.
    """

    surfels: Mapping[str, Tensor]
    view_color: str
    tiles: Tensor
    atlas: Tensor | None
    offset: float = 0.0
    scale: float = 1.0
    extent: Tensor | None = None
    mean_residual: Tensor | None = None
    near: float = 0.2
    weight_bound: float = 0.0
    prefilter: str = "low_pass"
    transmittance_min: float = TRANSMITTANCE_MIN
    _patches: tuple | None = field(default=None, init=False, repr=False, compare=False)

    @classmethod
    def from_bundle(cls, bundle: Bundle) -> BakedScene:
        """The scene of a loaded bundle."""
        info = bundle.info
        return cls(
            surfels=bundle.surfels,
            view_color=bundle.view_color,
            tiles=bundle.tiles.contiguous(),
            atlas=None if bundle.atlas is None else bundle.atlas.contiguous(),
            offset=bundle.offset,
            scale=bundle.scale,
            extent=bundle.extent,
            mean_residual=bundle.mean_residual,
            near=info["render"]["near"],
            weight_bound=info["render"]["weight_bound"],
            prefilter=info["render"].get("prefilter", "low_pass"),
        )

    def __len__(self) -> int:
        return len(self.tiles)

    @torch.no_grad()
    def render(self, camera: Camera, background: Tensor | None = None, maps: bool = False) -> BakedOutput:
        """Renders a view: texels are fetched bilinearly, clamped to the tile's outer texel centres.

        Args:
            camera: the view.
            background: [3] colour behind the scene; None = black.
            maps: also beta, depth, normals and overdraw.
        """
        p = self.surfels
        means = p["means"]
        geometry = (means, p["quats"], p["log_scales"], p["opacity_logits"], p["beta_raw"])
        projection = project(*geometry, camera, self.near, self.prefilter == "pixel")
        base = view_color(self.view_color, p, means, camera.exact_center, projection.visible)
        size = (camera.width, camera.height)
        image = means.new_empty(camera.height, camera.width, 9 if maps else 4)
        overdraw = torch.empty(camera.height, camera.width, 1, dtype=torch.int32) if maps else None
        tracer = tracers.take(means)
        tracer.run(projection.geom, projection.radii, *size, self.near, fragments=False)
        is_bytes = self.atlas is not None and self.atlas.dtype == torch.uint8
        tracer.baked(
            projection.geom,
            projection.radii,
            *size,
            self.near,
            self.weight_bound,
            self.transmittance_min,
            maps,
            base,
            self._gathered(),
            self.offset,
            self.scale / 255 if is_bytes else self.scale,
            torch.full((len(self),), 3.0) if self.extent is None else self.extent,
            torch.zeros(len(self), 3) if self.mean_residual is None else self.mean_residual,
            image,
            overdraw,
        )
        tracers.give(tracer)
        rgb, alpha = image[..., :3], image[..., 3:4]
        if background is not None:
            rgb = rgb + (1 - alpha) * background
        beta, depth, normal = (image[..., 4:5], image[..., 5:6], image[..., 6:9]) if maps else (None, None, None)
        return BakedOutput(rgb, alpha, beta, depth, normal, overdraw)

    def _gathered(self):
        """The atlas as the kernel reads it: gathered for the first view, kept while atlas and tiles are the same."""
        atlas, tiles = self.atlas, self.tiles
        state = (id(atlas), 0 if atlas is None else atlas._version, id(tiles), tiles._version)
        if self._patches is None or self._patches[0] != state:
            is_bytes = atlas is not None and atlas.dtype == torch.uint8
            shape = (0, 0, 0) if atlas is None else tuple(atlas.shape[:3])
            patches = module(tiles.device).Patches(
                atlas if is_bytes else None, None if is_bytes else atlas, shape, tiles.contiguous()
            )
            self._patches = (state, patches)
        return self._patches[1]
