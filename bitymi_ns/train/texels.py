"""Texels that learn in the last part of a run: every surfel gets a tile as fine as the training views see it."""

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
from bitymi_ns.ops import TexelDescent, add_texel_coverage, fitting_lists, project
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.project import GEOMETRY
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.tile_sizes import coarsened, kernel_parameters, max_projected_extent, seen_sides, visible_extent
from bitymi_ns.scene.visibility import Visibility, visibility
from bitymi_ns.train.init import tangents
from bitymi_ns.train.losses import numbers
from bitymi_ns.train.processes import Processes
from bitymi_ns.train.views import OnDemand, at_size, spread

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene
    from bitymi_ns.train.config import TexelConfig
    from bitymi_ns.train.schedules import Schedule
    from bitymi_ns.train.views import DownscaledViews, View

FEWEST_VIEWS = 32  # fewest views that tiles are measured on, however short the run
SMALLEST = 4  # side of the smallest tile, texels: a block of BC7
FEW = 1 << 23  # texels that no run is too short for: 235 MB
FEWER = 0.8  # factor by which tiles get fewer texels, as often as it takes until all are few enough
LEAST_SHARE = 0.25
"""Lower bound of a texel's coverage where it is measured on a part of the views, as a share of what one view
can show: no step is much longer than four times the rate. A whole view would slow down occluded texels."""
SURVEY_PIXELS = 10_000
"""Coverage is measured at half the size of the photographs where so many pixels remain: as accurate, in half
the time."""


class LearningTexels:
    """The part of a run in which texels learn."""

    def __init__(self, scene: Scene, schedule: Schedule, processes: Processes) -> None:
        self.scene, self.schedule, self.options, self.processes = scene, schedule, schedule.config.texels, processes
        self._rates: list[RemovableHandle] = []
        self._views = 1

    def begin(self, step: int, views: DownscaledViews) -> bool:
        """Create the tiles on the first step that needs them; True where this step is it."""
        self._views = len(views)
        if not self.schedule.texels_learn(step) or isinstance(self.scene.field, TexelField):
            return False
        sample = spread(len(views), max(FEWEST_VIEWS, round(self.options.views * self.schedule.texel_steps)))
        some = OnDemand(len(sample), lambda i: views.at(sample[i], 1.0))
        field = None
        if self.processes.first:
            field = blank_texels(self.scene, some, len(views), self.options, self.views_to_come)
        if self.processes.count > 1:
            device = self.scene.surfels["means"].device
            found = self.processes.from_first(None if field is None else field.state_dict(), device)
            field = TexelField(found["size"], found["extent"], found["texels"], found["share"], found.get("alpha"))
        self.scene.field = field
        return True

    @property
    def views_to_come(self) -> int:
        """Views that the steps of this part render, counted with repetition."""
        return self.processes.views * self.schedule.texel_steps

    def prepare(self, step: int, view: View, factor: float) -> None:
        """Set the step size of the texels for the backward pass of this view."""
        field = self.scene.field
        if not isinstance(field, TexelField):
            return
        # the loss is a mean, the step wants a sum
        values = numbers(view.image, view.mask, view.counted)
        rate = factor * self.schedule.texel_rate(step, self._views) * values
        for handle in self._rates:
            handle.remove()
        self._rates = []
        # one view moves the colours in its backward pass; several move them together, in `step`
        field.descent = TexelDescent(field.share, rate) if self.processes.views == 1 else None
        if field.descent is None:
            self._rates.append(field.texels.register_hook(lambda gradient: gradient * rate))
        if field.alpha is not None:
            alpha_rate = self.options.alpha_rate * rate
            self._rates.append(field.alpha.register_hook(lambda gradient: gradient * alpha_rate))

    @property
    def _stepped(self) -> list[Parameter]:
        """Colours and alphas of the texels that `step` moves."""
        field = self.scene.field
        if not isinstance(field, TexelField):
            return []
        colors = [] if self.processes.views == 1 else [field.texels]
        return colors if field.alpha is None else [*colors, field.alpha]

    @torch.no_grad()
    def average(self) -> None:
        """Make the gradients those of the mean loss of all views of the step. Processes exchange those of the
        texels alone that are not 0 in all of them."""
        stepped = self._stepped
        for values in stepped:
            if values.grad is None:
                values.grad = torch.zeros_like(values)
        gradients = [values.grad.view(len(values), -1) for values in stepped]
        if self.processes.count > 1 and stepped:
            moved = sum(gradient.any(1).to(torch.uint8) for gradient in gradients)
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
        """Move colours and alphas by the mean of the steps of all views."""
        field = self.scene.field
        for values in self._stepped:
            if values.grad is not None:
                share = field.share if values is field.alpha else field.share[:, None]
                values.addcmul_(share, values.grad, value=-1.0)
                values.grad = None
                if values is field.alpha:
                    values.clamp_(0.0, ALPHA_LIMIT)


@torch.no_grad()
def blank_texels(
    scene: Scene, views: Sequence[View], count: int, options: TexelConfig, to_come: float = math.inf
) -> TexelField:
    """A tile for every surfel, with residuals of 0, and alphas of 1 where they learn.

    A surfel of which no view shows a residual has one texel.

    Args:
        views: sample to measure on, at full size; their pictures do not matter.
        count: of all training views, which these stand for.
        to_come: views that the texels learn from, counted with repetition.
    """
    surfels = {name: value.detach() for name, value in scene.surfels.items()}
    cameras = [view.camera for view in views]
    bound = scene.config.weight_bound
    scale = 0.5 if mean_pixels(cameras) >= 4 * SURVEY_PIXELS else 1.0
    smaller = [camera.scaled(scale) for camera in cameras]
    seen = visibility(surfels, smaller, scene.near, bound, scene.config.prefilter)
    seen = replace(seen, pixels=seen.pixels / scale**2)
    size, extent = tiles_as_seen(surfels, cameras, seen, scene.near, bound, options, to_come)
    field = TexelField(size, extent, extent.new_zeros(int(size.long().prod(1).sum()), 3))
    small = OnDemand(len(views), lambda i: at_size(views[i], smaller[i], extent.device))
    seen_in_all = coverage(scene, field, small) * (count / max(1, len(views)) / scale**2)
    if len(views) < count:
        least = LEAST_SHARE * single_view_coverage(surfels, cameras, size, extent, scene.near)
        seen_in_all = torch.maximum(seen_in_all, least)
    field.share.copy_(1.0 / (seen_in_all + options.prior))
    if options.alpha_rate > 0:
        field.alpha = Parameter(torch.ones_like(field.share))
    return field


def most_texels(options: TexelConfig, rendered: float) -> float:
    """Most texels of all tiles, for steps that render so many pixels."""
    return max(FEW, rendered / options.rendered_pixels_per_texel)


def mean_pixels(cameras: Sequence[Camera]) -> float:
    """Mean pixels of a view; 0 without views."""
    return sum(camera.width * camera.height for camera in cameras) / max(1, len(cameras))


def single_view_coverage(
    surfels: Mapping[str, Tensor], cameras: Sequence[Camera], size: Tensor, extent: Tensor, near: float
) -> Tensor:
    """About as much as a view can show of every texel, pixels [T]: its area in the view that is nearest to it, whether
    or not that shows it, times the surfel's opacity.

    A view that is not measured may show what all others hide: by the measured coverage alone, its texels would take
    steps a hundred times too long.

    Args:
        cameras: the measured views; the others are about as near.
        size: [N, 2] of the tiles.
        extent: [N] half sides of the tiles in scale units.
        near: nearest drawn depth.
    """
    area = tile_pixels(surfels, cameras, extent, near).prod(1) / size.prod(1)
    return (area * surfels["opacity_logits"].sigmoid()).repeat_interleave(size.long().prod(1))


def tile_pixels(surfels: Mapping[str, Tensor], cameras: Sequence[Camera], extent: Tensor, near: float) -> Tensor:
    """Sides of the tiles of half sides `extent` in the view that shows them largest: pixels [N, 2]."""
    scales, axes = surfels["log_scales"].exp(), tangents(surfels["quats"])
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
    """Tiles that reach as far as fragments reach the weight bound, with at most a texel for so many pixels of the view
    that shows most of the surfel.

    Args:
        near: nearest drawn depth.
        weight_bound: fragments of smaller weight get no residual.
        to_come: views that the texels learn from, counted with repetition.

    Returns:
        sizes [N, 2] int32 and half sides [N] in scale units; 1 x 1 where no fragment reaches the bound.
    """
    extent = visible_extent(*kernel_parameters(surfels, seen.in_front), weight_bound)
    size = seen_sides(tile_pixels(surfels, cameras, extent, near), SMALLEST, options.largest)
    texels = seen.pixels / options.pixels_per_texel
    most = most_texels(options, to_come * mean_pixels(cameras))
    size = coarsened(size, texels, SMALLEST)
    while int(size.long().prod(1).sum()) > most and int(size.max()) > SMALLEST:
        texels = FEWER * texels
        size = coarsened(size, texels, SMALLEST)
    size[extent <= 0] = 1
    return size, torch.where(extent > 0, extent, torch.full_like(extent, SUPPORT))


@torch.no_grad()
def coverage(scene: Scene, field: TexelField, views: Sequence[View]) -> Tensor:
    """Coverage of every texel in pixels: [T] sum over views and fragments of the blending weight
    times the bilinear weight, in pixels that count; 0 where no view sees it."""
    total = torch.zeros_like(field.texels)
    for view in views:
        geometry = (scene.surfels[name].detach() for name in GEOMETRY)
        camera = view.camera.to(total.device)
        projection = project(*geometry, camera, scene.near, scene.config.prefilter)
        add_texel_coverage(fitting_lists(projection), field.tiles, view.mask, scene.config.weight_bound, total)
    return total[:, 0]
