"""The scene: parameters and rendering."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

from bitymi_ns.ops import (
    VIEW_COLORS,
    Fragments,
    Projection,
    composite_image,
    project,
    shade,
    trace,
    view_color,
)

from .camera import Camera
from .config import SceneConfig
from .field import HashField

GEOMETRY = ("means", "quats", "log_scales", "opacity_logits", "beta_raw")
"""Names of the per-surfel parameters that every scene has."""


@dataclass
class RenderOutput:
    """A rendered view.

    Attributes:
        rgb: [H, W, 3] colour over the background, linear in the images' own scale, not clamped.
        alpha: [H, W, 1] coverage.
        beta: [H, W, 1] sum of w beta, the paper's alpha-blended Beta value.
        depth: [H, W, 1] sum of w z, camera z, not divided by alpha; None without maps.
        normal: [H, W, 3] sum of w n, camera frame (OpenCV), facing the camera; None without maps.
        fragments: the view's fragments.
        projection: the view's surfels.
    """

    rgb: Tensor
    alpha: Tensor
    beta: Tensor
    depth: Tensor | None
    normal: Tensor | None
    fragments: Fragments
    projection: Projection

    @property
    def overdraw(self) -> Tensor:
        """[H, W, 1] int32: blended surfels a pixel."""
        return self.fragments.overdraw()


class Scene(nn.Module):
    """Beta surfels with a view-dependent colour each, and a residual colour field.

    Args:
        config: the representation.
        surfels: initial per-surfel parameters by name (docs/architecture.md), first dimension N each.
        field: residual colour field, None = surfels alone.

    Raises:
        ValueError: a parameter is missing or does not belong to the chosen view colour.
    """

    def __init__(self, config: SceneConfig, surfels: Mapping[str, Tensor], field: HashField | None) -> None:
        super().__init__()
        names = (*GEOMETRY, *VIEW_COLORS[config.view_color])
        if set(surfels) != set(names):
            raise ValueError(f"a scene with view colour '{config.view_color}' has {names}, not {tuple(surfels)}")
        self.config = config
        self.surfels = nn.ParameterDict({name: nn.Parameter(surfels[name].detach().clone()) for name in names})
        self.field = field

    def __len__(self) -> int:
        return self.surfels["means"].shape[0]

    def resize(self, n: int) -> None:
        """Gives every per-surfel parameter n rows of zeros in place, for loading a checkpoint."""
        for parameter in self.surfels.values():
            parameter.data = parameter.new_zeros(n, *parameter.shape[1:])

    def parameters_per_surfel(self) -> int:
        """Numbers stored a surfel: 60 for sv, 59 for sh, 26 for sb."""
        return sum(p[:1].numel() if len(p) else p.new_zeros(1, *p.shape[1:]).numel() for p in self.surfels.values())

    def base_color(self, projection: Projection) -> Tensor:
        """[N, 3] f_view(d) of the surfels that the camera sees, 0 elsewhere."""
        means = self.surfels["means"]
        center = projection.camera.exact_center
        return view_color(self.config.view_color, self.surfels, means, center, projection.visible)

    def render(
        self,
        camera: Camera,
        background: Tensor | None = None,
        field_mode: Literal["train", "frozen", "off"] = "train",
        maps: bool = False,
        weight_bound: float | None = None,
    ) -> RenderOutput:
        """Renders a view: visibility, then shading, then compositing.

        Args:
            camera: the view.
            background: [3] colour behind the scene; None = black.
            field_mode: train = the residual field gets gradients; frozen = it is evaluated without; off = left out.
            maps: also depth and normals.
            weight_bound: fragments of smaller weight keep the surfel's colour, without residual; None = as configured.
        """
        p = self.surfels
        projection = project(
            *(p[name] for name in GEOMETRY), camera, self.config.near, self.config.prefilter == "pixel"
        )
        fragments = trace(projection, self.config.rim)
        geometry, weights = None, ()
        if self.field is not None and field_mode != "off":
            geometry, weights = self.field.geometry, self.field.weights
            if field_mode == "frozen":
                weights = tuple(w.detach() for w in weights)
        colors = shade(
            fragments,
            self.base_color(projection),
            projection.frames,
            geometry,
            weights,
            self.config.weight_bound if weight_bound is None else weight_bound,
            move_surfels=self.config.texture_moves_surfels and field_mode == "train",
        )
        image = composite_image(fragments, projection, colors, maps).view(camera.height, camera.width, -1)
        rgb, alpha = image[..., :3], image[..., 3:4]
        if background is not None:
            rgb = rgb + (1 - alpha) * background
        return RenderOutput(
            rgb=rgb,
            alpha=alpha,
            beta=image[..., 4:5],
            depth=image[..., 5:6] if maps else None,
            normal=image[..., 6:9] if maps else None,
            fragments=fragments,
            projection=projection,
        )
