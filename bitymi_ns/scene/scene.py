"""Scene: parameters and rendering."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bitymi_ns.ops import (
    VIEW_COLORS,
    Fragments,
    Projection,
    TexelAlpha,
    TexelDescent,
    Unlisted,
    blended_image,
    can_rasterize,
    draw_by_lists,
    project,
    rasterize_image,
    soft_overdraw,
    trace,
    view_color,
)
from bitymi_ns.ops.capacity import memory_errors
from bitymi_ns.ops.parameters import GEOMETRY, Tensors
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.ops.training_view import ComparedView, PhotographTarget, training_view
from .camera import Camera
from .config import SceneConfig
from .field import HashField, TexelField

NEAR = 0.02  # near plane for cameras of extent 1


@dataclass
class RenderOutput:
    """A rendered view.

    Attributes:
        rgb: [H, W, 3] colour over the background, encoded as in the photographs, not clamped.
        alpha: [H, W, 1] coverage.
        beta: [H, W, 1] sum of w beta, the paper's alpha-blended Beta value.
        depth: [H, W, 1] sum of w z, camera z, not divided by alpha; None without maps.
        normal: [H, W, 3] sum of w n, camera frame (OpenCV), facing the camera; None without maps.
        soft_overdraw: [H, W, 1] differentiable count of fragments per pixel; None without `overdraw_half`.
        fragments: blended fragments; `Unlisted` if rendered without a list of all.
        projection: projected surfels.
    """

    rgb: Tensor
    alpha: Tensor
    beta: Tensor
    depth: Tensor | None
    normal: Tensor | None
    soft_overdraw: Tensor | None
    fragments: Fragments | Unlisted
    projection: Projection

    @classmethod
    def of_image(
        cls,
        image: Tensor,
        projection: Projection,
        fragments: Fragments | Unlisted,
        background: Tensor | None,
        maps: bool,
        soft_overdraw: bool = False,
    ) -> RenderOutput:
        """Compose a blended image over a background and split its channels.

        Args:
            image: [H * W, C] of `ops.blended_image`, with the soft overdraw, if any, as last channel.
            background: [3] colour behind the scene; None: black.
            maps: the image has depth and normals.
            soft_overdraw: the image has the soft overdraw.
        """
        image = image.view(projection.camera.height, projection.camera.width, -1)
        if background is not None:
            behind = torch.nn.functional.pad(background, (0, image.shape[-1] - 3))
            image = torch.addcmul(image, 1.0 - image[..., 3:4], behind)
        return cls(
            rgb=image[..., :3],
            alpha=image[..., 3:4],
            beta=image[..., 4:5],
            depth=image[..., 5:6] if maps else None,
            normal=image[..., 6:9] if maps else None,
            soft_overdraw=image[..., -1:] if soft_overdraw else None,
            fragments=fragments,
            projection=projection,
        )

    @property
    def overdraw(self) -> Tensor:
        """Number of blended surfels per pixel, [H, W, 1] int32."""
        return self.fragments.overdraw()


class Scene(nn.Module):
    """Beta surfels with view-dependent colours, and residual colours.

    Args:
        surfels: initial per-surfel parameters by name (docs/overview.md), first dimension N each.
        field: residual colours, `HashField` or `TexelField`; None: no residual.
        near: near plane, camera z, if the configuration does not state it.

    Raises:
        ValueError: the parameters are not those of the chosen view colour.
    """

    def __init__(
        self,
        config: SceneConfig,
        surfels: Mapping[str, Tensor],
        field: HashField | TexelField | None,
        near: float = NEAR,
    ) -> None:
        super().__init__()
        names = (*GEOMETRY, *VIEW_COLORS[config.view_color].names)
        if set(surfels) != set(names):
            raise ValueError(f"a scene with view colour '{config.view_color}' has {names}, not {tuple(surfels)}")
        self.config = config
        self.surfels = nn.ParameterDict({name: nn.Parameter(surfels[name].detach().clone()) for name in names})
        self.field = field
        self.near = near if config.near is None else config.near

    def __len__(self) -> int:
        return self.surfels["means"].shape[0]

    def resize_for_state(self, state: Mapping[str, Tensor], prefix: str = "") -> None:
        """Resize surfel parameters and texels for a state that is loaded next. `state`: state of a scene of the same
        configuration. `prefix`: prefix of the names in `state`."""
        n = len(state[f"{prefix}surfels.means"])
        for parameter in self.surfels.values():
            parameter.data = parameter.new_zeros(n, *parameter.shape[1:])
        texels = state.get(f"{prefix}field.texels")
        if texels is not None:
            alpha = f"{prefix}field.alpha" in state
            self.field = TexelField.blank(n, len(texels), self.surfels["means"].detach(), alpha)
        elif isinstance(self.field, TexelField):
            self.field = None

    def base_color(self, projection: Projection) -> Tensor:
        """Compute the view-dependent colours f_view(d), [N, 3]; 0 for surfels that are not visible."""
        means = self.surfels["means"]
        center = projection.camera.exact_center
        return view_color(self.config.view_color, self.surfels, means, center, projection.visible)

    def opacity(self, learns: bool) -> TexelAlpha | None:
        """Return the opacities of texels, with or without gradients; None: opaque texels, or none."""
        return self.field.opacity(self.config.weight_bound, learns) if isinstance(self.field, TexelField) else None

    def _surfels_with(self, opacity_logits: Tensor | None) -> Tensors:
        return self.surfels if opacity_logits is None else {**self.surfels, "opacity_logits": opacity_logits}

    @memory_errors()
    def render(
        self,
        camera: Camera,
        background: Tensor | None = None,
        field_mode: Literal["train", "frozen"] = "train",
        maps: bool = False,
        overdraw_half: float | None = None,
        descent: TexelDescent | None = None,
        opacity_logits: Tensor | None = None,
    ) -> RenderOutput:
        """Render a view: visibility, then shading, then compositing.

        On a GPU scenes without a hash field are rasterized without fragment lists, unless soft overdraw is requested. A
        view with more fragments than `config.max_fragments`, or than memory holds, is rendered in bands.

        Args:
            background: [3] colour behind the scene; None: black.
            field_mode: train = residual with gradients; frozen = residual without gradients.
            maps: also render depth and normals.
            overdraw_half: also render the soft overdraw, see `ops.soft_overdraw`; None: no.
            descent: update of the texels of a `TexelField` by the backward pass; None: they get a gradient.
            opacity_logits: [N] instead of the surfels' own; None: these.

        Raises:
            TooManyFragments: a single row of screen tiles has too many.
            MemoryError: the picture does not fit into memory.
        """
        p, field = self._surfels_with(opacity_logits), self.field
        learns, bound = field_mode == "train", self.config.weight_bound
        descent = descent if learns else None
        projection = project(*geometry_of(p), camera=camera, near=self.near, alpha=self.opacity(learns))
        texture = None if overdraw_half is not None else self._unlisted_texture(learns, descent)
        base = self.base_color(projection)
        if texture is not None:
            image, fragments = rasterize_image(projection, base, **texture, maps=maps, rim=self.config.rim)
            return RenderOutput.of_image(image, projection, fragments, background, maps)
        read: Tensor | None = None

        def draw(part: Projection, most: int | None) -> tuple[Tensor, Fragments]:
            nonlocal read
            if part.whole is not None and read is None and descent is not None and isinstance(field, TexelField):
                read = field.texels.detach().clone()  # a band's backward pass moves texels that others read again
            fragments = trace(part, self.config.rim, most)
            shading: dict[str, Any] = {}
            if isinstance(field, TexelField):
                shading = field.texture(bound, learns, descent, read)
            elif field is not None:
                shading["residual"] = field.residual(fragments, part.frames, bound, learns)
            image = blended_image(fragments, part, base, maps=maps, **shading)
            if overdraw_half is not None:
                image = torch.cat([image, soft_overdraw(fragments, overdraw_half).unsqueeze(1)], 1)
            return image, fragments

        image, fragments = draw_by_lists(projection, draw, self.config.max_fragments, self.config.rim)
        return RenderOutput.of_image(image, projection, fragments, background, maps, overdraw_half is not None)

    def _unlisted_texture(self, learns: bool, descent: TexelDescent | None) -> dict[str, Any] | None:
        """Return the texel arguments of `rasterize_image`, {} without texels; None if views need fragment lists."""
        by_lists = self.config.max_fragments or not can_rasterize(self.surfels["means"].device)
        if by_lists or isinstance(self.field, HashField):
            return None
        return {} if self.field is None else self.field.texture(self.config.weight_bound, learns, descent)

    def compare(
        self,
        camera: Camera,
        photograph: PhotographTarget,
        correction: Tensor | None = None,
        field_mode: Literal["train", "frozen"] = "train",
        descent: TexelDescent | None = None,
        opacity_logits: Tensor | None = None,
    ) -> ComparedView | None:
        """Draw a view and compare it with its photograph, see `ops.training_view`; None if views need fragment lists.
        `correction`: colour correction, [3] or [3, 4], see `train.views.View`. `field_mode`, `descent`,
        `opacity_logits`: as in `render`."""
        learns = field_mode == "train"
        texture = self._unlisted_texture(learns, descent if learns else None)
        if texture is None:
            return None
        view = {"near": self.near, "rim": self.config.rim, "alpha": self.opacity(learns)}
        surfels = self._surfels_with(opacity_logits)
        return training_view(self.config.view_color, surfels, camera, photograph, correction, **texture, **view)
