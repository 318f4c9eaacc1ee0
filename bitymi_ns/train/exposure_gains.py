"""Exposure gains of photographs, estimated from the colours of the sparse points.

In logarithms, observation = point + photograph: two-way data, solved by medians in turn, which no highlight, nothing in
front of a point and no wrong point can move by much. Points that others hide in a photograph do not count there."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View, as_float

POINTS = 6000  # most points compared
HIDING = 100_000  # most points that may occlude them
OBSERVATIONS = 1_200_000  # points times photographs, at most
SWEEPS = 10  # passes over points and photographs
DARKEST, BRIGHTEST = 0.03, 0.97  # channels beyond these are left out: noise, rounding and clipping decide them
FEWEST_PHOTOGRAPHS = 3  # points that fewer photographs show are left out
CELL = 2.0  # side of the cells of the occlusion test, in mean distances of the points in the picture
HIDDEN = 1.05  # a point is hidden where one in its cell or a neighbouring one is nearer by this factor
FEWEST_TESTED = 1000  # fewest observations for a test on the other half of the points


class ExposureGains(NamedTuple):
    """Gains of the photographs, and how well they explain the differences of colours."""

    log_gains: Tensor  # [V, 3] float32 natural logarithm of each photograph's gain per channel; each channel has mean 0
    points: Tensor  # [V] int64, how many points each photograph was judged by
    # median over the observations of one half of the points of how far they are from their point's colour, in natural
    # logarithms; NaN where there were too few
    before: float
    after: float  # the same once the gains found on the other half of the points are taken out

    @property
    def explained(self) -> float:
        """Share of the disagreement that gains explain, on points that they were not found on; NaN = cannot be told."""
        return 1.0 - self.after / self.before if self.before > 0.0 else math.nan


@torch.no_grad()
def estimate_gains(points: Tensor, views: Sequence[View], near: float) -> ExposureGains:
    """Compares the photographs at the points.

    Args:
        points: [M, 3] world positions.
        views: V photographs at full size; each is asked for once. Pixels that their masks exclude or that are
            transparent do not count.
        near: nearest drawn depth, camera z.
    """
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:HIDING]
    points = points.detach()[order.to(points.device)]
    count = min(len(points), POINTS, max(1, OBSERVATIONS // max(1, len(views))))
    logs = torch.full((len(views), count, 3), math.nan)
    for row, view in enumerate(views):
        logs[row] = _log_colors(view, points, count, near).cpu()
    logs = logs[:, logs.isfinite().all(-1).sum(0) >= FEWEST_PHOTOGRAPHS]
    count = logs.isfinite().all(-1).sum(1)
    half, other = logs[:, ::2], logs[:, 1::2]
    before = after = math.nan
    if int(other.isfinite().sum()) >= FEWEST_TESTED:
        before, after = _disagreement(other), _disagreement(other - _log_gains(half)[:, None])
    return ExposureGains(_log_gains(logs), count, before, after)


def _log_colors(view: View, points: Tensor, count: int, near: float) -> Tensor:
    """[C, 3] logarithm of the colour at the pixel of each of the first points; NaN where it is hidden or does not
    count. All points may hide them."""
    camera = view.camera.to(points.device)
    x, y, z, inside = camera.project(points, near)
    side = max(2.0, CELL * math.sqrt(camera.width * camera.height / max(1, int(inside.sum()))))
    columns, rows = math.ceil(camera.width / side), math.ceil(camera.height / side)
    cell = (y / side).long().clamp(0, rows - 1) * columns + (x / side).long().clamp(0, columns - 1)
    nearest = torch.full((rows * columns,), math.inf, device=z.device)
    nearest = nearest.scatter_reduce(0, cell[inside], z[inside], "amin").view(1, 1, rows, columns)
    around = -max_pool2d(-nearest, 3, stride=1, padding=1).flatten()
    shown = inside & (z <= HIDDEN * around[cell])

    color = as_float(_pixels(view.image, camera, x[:count], y[:count]))
    shown = shown[:count].to(color.device)
    if color.shape[-1] == 4:
        shown = shown & (color[:, 3] > 0.99)
    if view.mask is not None:
        shown = shown & _pixels(view.mask, camera, x[:count], y[:count]).flatten().bool()
    color = color[:, :3]
    counts = shown[:, None] & (color > DARKEST) & (color < BRIGHTEST)
    return torch.where(counts, color.log(), math.nan)


def _pixels(image: Tensor, camera: Camera, x: Tensor, y: Tensor) -> Tensor:
    """[C, ...] the pixels [H, W, ...] at image positions of the camera, whose size may be another; NaN gives any."""
    at = (
        (along.nan_to_num(0.0) * size / full).long().clamp(0, size - 1).to(image.device)
        for along, size, full in zip((y, x), image.shape[:2], (camera.height, camera.width), strict=True)
    )
    return image[tuple(at)]


def _log_gains(logs: Tensor) -> Tensor:
    """[V, 3] gains of the photographs, by medians in turn; 0 for one that shows no point. Mean 0 per channel."""
    gains = torch.zeros(len(logs), 3)
    if logs.shape[1] == 0:
        return gains
    for _ in range(SWEEPS):
        colors = _median(logs - gains[:, None], 0)
        gains = _median(logs - colors, 1).nan_to_num(0.0)
        gains -= gains.mean(0)
    return gains


def _disagreement(logs: Tensor) -> float:
    """Median distance of the observations from the median of their point."""
    apart = (logs - _median(logs, 0)).abs()
    return float(_median(apart[apart.isfinite()], 0))


def _median(values: Tensor, dim: int) -> Tensor:
    """Median along a dimension, NaN left out; the mean of the two in the middle where there are so many. NaN of none.

    The lower of the two, which torch takes, would find photographs in pairs to differ by more than they do."""
    if values.shape[dim] == 0:
        return torch.full_like(values.sum(dim), math.nan)
    return 0.5 * (values.nanmedian(dim).values - (-values).nanmedian(dim).values)
