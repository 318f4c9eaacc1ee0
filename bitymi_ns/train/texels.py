"""The texel stage of a run: every surfel gets a tile at the resolution of the training views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.utils.hooks import RemovableHandle

from bitymi_ns.codec.limits import ALPHA_LIMIT
from bitymi_ns.ops import TexelDescent, add_texel_coverage, project
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.tile_sizes import coarsened, kernel_parameters, max_projected_extent, seen_sides, visible_extent
from bitymi_ns.scene.visibility import Visibility, visibility
from .init import tangents
from .losses import count_values
from .memory import PER_TEXEL, PER_TEXEL_SUM, room_to_grow
from .processes import Processes
from .views import OnDemand, at_size

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene
    from .config import TexelConfig
    from .schedules import Schedule
    from .views import DownscaledViews, View

SMALLEST = 4  # side of the smallest tile: a block of BC7
FEW = 1 << 23  # texels that runs of any length may have: 370 MB
FEWER = 0.8  # factor on the texels per tile, until the total is below the limit
LEAST_COVERAGE = 0.25
"""Lower bound of a texel's coverage if only some views are measured, relative to that in one view: limits its step to
about four times the rate, without slowing down occluded texels."""
SURVEY_PIXELS = 10_000  # coverage is measured at half size if views then have as many: as accurate


class LearningTexels:
    """Optimisation of the texels in the texel stage."""

    def __init__(self, scene: Scene, schedule: Schedule, processes: Processes) -> None:
        self.scene = scene
        self.schedule = schedule
        self.options = schedule.config.texels
        self.processes = processes
        self._rates: list[RemovableHandle] = []
        self._views = 1
        self.most_by_memory = 0  # texels to which memory has limited the tiles; 0: it has not

    @property
    def views_to_come(self) -> int:
        """Number of renders in the texel stage, over all processes."""
        return self.processes.views * self.schedule.texel_steps

    def begin(self, step: int, views: DownscaledViews) -> bool:
        """Create the tiles and return True in the first step of the texel stage."""
        self._views = len(views)
        if not self.schedule.texels_learn(step) or isinstance(self.scene.field, TexelField):
            return False
        sample = spread(len(views), self.schedule.survey_views)
        sampled = OnDemand(len(sample), lambda i: views.at(sample[i], 1.0))
        device = self.scene.surfels["means"].device
        texel_bytes = PER_TEXEL + PER_TEXEL_SUM * (device.type == "cuda")
        fitting = max(0, int(room_to_grow(device, self.processes) / texel_bytes))
        made = None
        if self.processes.first:
            made = blank_texels(self.scene, sampled, len(views), self.options, self.views_to_come, fitting)
        stated = None if made is None else {**made[0].state_dict(), "bound": made[1]}
        stated = self.processes.from_first(stated, device)
        self.most_by_memory = len(stated["texels"]) if stated.pop("bound") else 0
        self.scene.field = TexelField(**stated) if made is None else made[0]
        return True

    def prepare(self, step: int, view: View, factor: float) -> TexelDescent | None:
        """Return the update of the texels by the backward pass of this view; None with several views per step, whose
        gradients are scaled by the step size."""
        field = self.scene.field
        if not isinstance(field, TexelField):
            return None
        # the loss is a mean, but a texel's step is defined by the sum
        values = count_values(view.image, view.mask, view.counted)
        rate = factor * self.schedule.texel_rate(step, self._views) * values
        for handle in self._rates:
            handle.remove()
        self._rates = []
        descent = TexelDescent(field.share, rate) if self.processes.views == 1 else None
        if descent is None:
            self._rates.append(field.texels.register_hook(lambda gradient: gradient * rate))
        if field.alpha is not None:
            alpha_rate = self.options.alpha_rate * rate
            self._rates.append(field.alpha.register_hook(lambda gradient: gradient * alpha_rate))
        return descent

    @property
    def _parameters(self) -> list[Parameter]:
        """Colours, unless a backward pass updates them, and alphas."""
        field = self.scene.field
        if not isinstance(field, TexelField):
            return []
        colors = [] if self.processes.views == 1 else [field.texels]
        return colors if field.alpha is None else [*colors, field.alpha]

    @torch.no_grad()
    def average(self) -> None:
        """Average the gradients over all views of the step; processes exchange rows with a nonzero one."""
        parameters = self._parameters
        gradients = []
        for values in parameters:
            values.grad = torch.zeros_like(values) if values.grad is None else values.grad
            gradients.append(values.grad.view(len(values), -1))
        if self.processes.count > 1 and parameters:
            moved = torch.stack([gradient.any(1) for gradient in gradients]).any(0).to(torch.uint8)
            self.processes.maximum(moved)
            rows = moved.nonzero().flatten()
            sums = [gradient.index_select(0, rows) for gradient in gradients]
            self.processes.sum(*sums)
            for gradient, total in zip(gradients, sums, strict=True):
                gradient.index_copy_(0, rows, total)
        if gradients:
            torch._foreach_div_(gradients, float(self.processes.views))

    @torch.no_grad()
    def step(self) -> None:
        """Update colours and alphas by their averaged gradients."""
        field = self.scene.field
        if not isinstance(field, TexelField):
            return
        for values in self._parameters:
            if values.grad is not None:
                step_size = field.share if values is field.alpha else field.share[:, None]
                values.addcmul_(step_size, values.grad, value=-1.0)
                values.grad = None
                if values is field.alpha:
                    values.clamp_(0.0, ALPHA_LIMIT)


@torch.no_grad()
def blank_texels(
    scene: Scene,
    views: Sequence[View],
    count: int,
    options: TexelConfig,
    to_come: float = math.inf,
    fitting: float = math.inf,
) -> tuple[TexelField, bool]:
    """Create a tile for every surfel, with residuals of 0, and alphas of 1 if alphas are trained.

    A surfel without fragments that may have a residual gets one texel. `views`: sample of the `count` training views,
    at full size; cameras and masks are used. `to_come`: number of renders in the texel stage. `fitting`: maximum number
    of texels, as far as the smallest tiles allow. Returns the field, and whether `fitting` has reduced it."""
    surfels = {name: value.detach() for name, value in scene.surfels.items()}
    cameras = [view.camera for view in views]
    bound = scene.config.weight_bound
    scale = 0.5 if mean_pixels(cameras) >= 4 * SURVEY_PIXELS else 1.0
    smaller = [camera.scaled(scale) for camera in cameras]
    seen = visibility(surfels, smaller, scene.near, bound)
    seen = replace(seen, pixels=seen.pixels / scale**2)
    size, extent = tiles_as_seen(surfels, cameras, seen, scene.near, bound, options, to_come)
    wanted = int(size.long().prod(1).sum())
    size = bounded(size, seen.pixels / options.pixels_per_texel, fitting)
    field = TexelField(size, extent, extent.new_zeros(int(size.long().prod(1).sum()), 3))
    small = OnDemand(len(views), lambda i: at_size(views[i], smaller[i], extent.device))
    seen_in_all = coverage(scene, field, small) * (count / max(1, len(views)) / scale**2)
    if len(views) < count:
        least = LEAST_COVERAGE * single_view_coverage(surfels, cameras, size, extent, scene.near)
        seen_in_all = torch.maximum(seen_in_all, least)
    field.share.copy_(1.0 / (seen_in_all + options.prior))
    if options.alpha_rate > 0:
        field.alpha = Parameter(torch.ones_like(field.share))
    return field, len(field.texels) < wanted


def most_texels(options: TexelConfig, rendered: float) -> float:
    """Compute the maximum number of texels for a texel stage that renders `rendered` pixels."""
    return max(FEW, rendered / options.rendered_pixels_per_texel)


def mean_pixels(cameras: Sequence[Camera]) -> float:
    """Compute the mean number of pixels per view; 0 without views."""
    return sum(camera.width * camera.height for camera in cameras) / max(1, len(cameras))


def single_view_coverage(
    surfels: Mapping[str, Tensor], cameras: Sequence[Camera], size: Tensor, extent: Tensor, near: float
) -> Tensor:
    """Estimate the coverage of each texel in one unoccluded view, pixels [T]: its area in the nearest of `cameras`
    times the opacity. `size`, `extent`: [N, 2] and [N] of the tiles.

    Other views may show texels that all measured ones occlude; by the measured coverage alone, their steps would be a
    hundred times too long."""
    area = tile_pixels(surfels, cameras, extent, near).prod(1) / size.prod(1)
    return (area * surfels["opacity_logits"].sigmoid()).repeat_interleave(size.long().prod(1))


def tile_pixels(surfels: Mapping[str, Tensor], cameras: Sequence[Camera], extent: Tensor, near: float) -> Tensor:
    """Compute the sides [N, 2], pixels, of tiles of half sides `extent`, in the view where they are largest."""
    scales = surfels["log_scales"].exp()
    axes = tangents(surfels["quats"])
    return max_projected_extent(surfels["means"], axes, scales, cameras, SUPPORT, near) * (extent / SUPPORT)[:, None]


def tiles_as_seen(
    surfels: Mapping[str, Tensor],
    cameras: Sequence[Camera],
    seen: Visibility,
    near: float,
    weight_bound: float,
    options: TexelConfig,
    to_come: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """Choose sizes [N, 2] int32 and half sides [N], scale units, of tiles. They cover the part of a surfel where
    fragments reach the weight bound, at the resolution of the views; 1 x 1 if none does. `to_come`: as of
    `blank_texels`."""
    extent = visible_extent(*kernel_parameters(surfels, seen.in_front), weight_bound)
    size = seen_sides(tile_pixels(surfels, cameras, extent, near), SMALLEST, options.largest)
    texels = seen.pixels / options.pixels_per_texel
    most = most_texels(options, to_come * mean_pixels(cameras))
    size = bounded(coarsened(size, texels, SMALLEST), texels, most)
    size[extent <= 0] = 1
    return size, torch.where(extent > 0, extent, torch.full_like(extent, SUPPORT))


def bounded(size: Tensor, texels: Tensor, most: float) -> Tensor:
    """Coarsen tiles of `size` [N, 2] and at most `texels` [N] texels each to at most `most` in all, or the smallest
    size."""
    while int(size.long().prod(1).sum()) > most and int(size.max()) > SMALLEST:
        texels = FEWER * texels
        size = coarsened(size, texels, SMALLEST)
    return size


@torch.no_grad()
def coverage(scene: Scene, field: TexelField, views: Sequence[View]) -> Tensor:
    """Sum blending weight times bilinear weight of each texel over unmasked fragments and views: [T] pixels."""
    covered = field.texels.new_zeros(len(field.texels), 2)
    for view in views:
        geometry = (value.detach() for value in geometry_of(scene.surfels))
        camera = view.camera.to(covered.device)
        projection = project(*geometry, camera=camera, near=scene.near)
        add_texel_coverage(projection, field.tiles, view.mask, scene.config.weight_bound, covered)
    return covered[:, 0]
