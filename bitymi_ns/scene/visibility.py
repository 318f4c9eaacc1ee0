"""Visibility of surfels in views: those that blend them, and the transmittance in front of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns.ops import TexelAlpha, project, surfel_coverage
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.progress import Progress, no_progress
from .camera import Camera

if TYPE_CHECKING:
    from .scene import Scene

SAMPLE = 4096  # random surfels that are tested first: nearly all views see one of them
CHUNK = 1 << 20  # surfels tested at a time after that


@dataclass(frozen=True)
class Visibility:
    """Visibility of N surfels in the views.

    Attributes:
        transmittance: [N] float32, maximum T over the surfel's blended fragments in all views; 0 without any.
        pixels: [N] float32, maximum over the views of the sum of the surfel's blending weights that get a residual.
        squares: [V, N] bfloat16, sum over the view's pixels of the surfel's squared blending weight: a colour error e
            adds e^2 times this to the squared error.
    """

    transmittance: Tensor
    pixels: Tensor
    squares: Tensor

    @property
    def seen(self) -> Tensor:
        """[V, N] bool, whether the view blends the surfel."""
        return self.squares > 0

    @property
    def in_front(self) -> Tensor:
        """Transmittance [N], but 1 for surfels that no view blends."""
        return torch.where(self.transmittance > 0, self.transmittance, 1.0)

    def of(self, rows: Tensor) -> Visibility:
        """Select surfels by row."""
        return Visibility(self.transmittance[rows], self.pixels[rows], self.squares[:, rows])


@torch.no_grad()
def visibility(
    surfels: Mapping[str, Tensor],
    cameras: Sequence[Camera],
    near: float,
    weight_bound: float = 0.0,
    progress: Progress = no_progress,
    alpha: TexelAlpha | None = None,
) -> Visibility:
    """Find the views that show each surfel, and the transmittance in front of it.

    Args:
        surfels: per-surfel parameters (docs/overview.md), N rows, all finite.
        near: near plane, camera z.
        weight_bound: fragments of smaller weight get no residual.
        alpha: opacities of the surfels' texels; None: opaque texels.
    """
    means = surfels["means"]
    geometry = geometry_of(surfels)
    largest, pixels = means.new_zeros(2, len(means))
    squares = torch.zeros(len(cameras), len(means), dtype=torch.bfloat16, device=means.device)
    for done, camera in enumerate(cameras, start=1):
        projection = project(*geometry, camera=camera.to(means.device), near=near, alpha=alpha)
        shown = surfel_coverage(projection, weight_bound)
        largest = torch.maximum(largest, shown[:, 0])
        pixels = torch.maximum(pixels, shown[:, 1])
        squares[done - 1] = shown[:, 2]
        progress("looking through the training views", done, len(cameras))
    return Visibility(largest, pixels, squares)


@torch.no_grad()
def views_without_surfels(scene: Scene, cameras: Sequence[Camera]) -> list[int]:
    """List the indices of the views that no surfel's bounding sphere reaches, beyond the near plane."""
    means = scene.surfels["means"].detach()
    radii = SUPPORT * scene.surfels["log_scales"].detach().exp().amax(-1)
    first = torch.randperm(len(means), generator=torch.Generator().manual_seed(0))[:SAMPLE].to(means.device)
    return [
        i
        for i, camera in enumerate(cameras)
        if not _sees(camera, means[first], radii[first], scene.near)
        and not any(
            _sees(camera, *chunk, scene.near) for chunk in zip(means.split(CHUNK), radii.split(CHUNK), strict=True)
        )
    ]


def _sees(camera: Camera, means: Tensor, radii: Tensor, near: float) -> bool:
    camera = camera.to(means.device)
    x, y, z, _ = camera.project(means, near)
    seen = z > near - radii
    for position, focal, size in ((x, camera.K[0, 0], camera.width), (y, camera.K[1, 1], camera.height)):
        reach = focal * radii / z.clamp(min=near)
        seen &= (position > -reach) & (position < size + reach)
    return bool(seen.any())
