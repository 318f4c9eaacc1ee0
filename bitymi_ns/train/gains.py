"""Gains of photographs from their colours at the sparse points.

In logarithms, observation = point + photograph, solved by median polish, which is robust to highlights and wrong
points. Points occluded by others in a photograph are ignored there.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from bitymi_ns.scene.camera import Camera
from .views import View, as_float

POINTS = 6000  # maximum number compared
HIDING = 100_000  # maximum number that may occlude them
OBSERVATIONS = 1_200_000  # maximum of points times photographs
SWEEPS = 10  # passes of the median polish
DARKEST, BRIGHTEST = 0.03, 0.97  # beyond these channel values noise, rounding and clipping dominate
FEWEST_PHOTOGRAPHS = 3  # minimum number of photographs that show a point
CELL = 2.0  # side of the cells of the occlusion test, in mean spacings of the projected points
HIDDEN = 0.05  # an occluder is nearer by this part of its depth, or of twice the view's depth range if less
FEWEST_TESTED = 1000  # minimum number of observations to test gains on the other half of the points


class ExposureGains(NamedTuple):
    """Gains of the photographs, and how well they explain the colour differences."""

    log_gains: Tensor  # [V, 3] float32, natural logarithms, of mean 0 in each channel
    points: Tensor  # [V] int64, number of points used
    # fraction by which gains from half of the points reduce the median deviation of log colours from their point's
    # median on the other half; NaN: too few points, or no deviation
    explained: float


@torch.no_grad()
def estimate_gains(points: Tensor, views: Sequence[View], near: float) -> ExposureGains:
    """Estimate the gains of V photographs, `views` at full size, from their colours at points [M, 3], world positions,
    without masked and transparent pixels. `near`: near plane, camera z."""
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:HIDING]
    points = points.detach()[order.to(points.device)]
    count = min(len(points), POINTS, max(1, OBSERVATIONS // max(1, len(views))))
    logs = torch.full((len(views), count, 3), math.nan)
    for row, view in enumerate(views):
        logs[row] = _log_colors(view, points, count, near).cpu()
    logs = logs[:, logs.isfinite().all(-1).sum(0) >= FEWEST_PHOTOGRAPHS]
    count = logs.isfinite().all(-1).sum(1)
    half, other = logs[:, ::2], logs[:, 1::2]
    explained = math.nan
    if int(other.isfinite().sum()) >= FEWEST_TESTED and (before := _disagreement(other)) > 0.0:
        explained = 1.0 - _disagreement(other - _log_gains(half)[:, None]) / before
    return ExposureGains(_log_gains(logs), count, explained)


def _log_colors(view: View, points: Tensor, count: int, near: float) -> Tensor:
    """Read the log colours [count, 3] of a view at the first `count` points; NaN where occluded by any of the points,
    masked, transparent or out of range."""
    camera = view.camera.to(points.device)
    x, y, z, inside = camera.project(points, near)
    side = max(2.0, CELL * math.sqrt(camera.width * camera.height / max(1, int(inside.sum()))))
    columns, rows = math.ceil(camera.width / side), math.ceil(camera.height / side)
    cell = (y / side).long().clamp(0, rows - 1) * columns + (x / side).long().clamp(0, columns - 1)
    nearest = torch.full((rows * columns,), math.inf, device=z.device)
    nearest = nearest.scatter_reduce(0, cell[inside], z[inside], "amin").view(1, 1, rows, columns)
    around = -max_pool2d(-nearest, 3, stride=1, padding=1).flatten()
    depths = z[inside].sort().values if bool(inside.any()) else z.new_zeros(1)
    spread = depths[int(0.99 * (len(depths) - 1))] - depths[int(0.01 * (len(depths) - 1))]
    shown = inside & (z <= around[cell] + HIDDEN * torch.minimum(around[cell], 2.0 * spread))

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
    """Read the pixels [P, ...] of an image at P positions of a camera, whose image size may differ."""
    row, column = (
        (position.nan_to_num(0.0) * size / full).long().clamp(0, size - 1).to(image.device)
        for position, size, full in zip((y, x), image.shape[:2], (camera.height, camera.width), strict=True)
    )
    return image[row, column]


def _log_gains(logs: Tensor) -> Tensor:
    """Compute log gains [V, 3] by median polish, mean 0 per channel; 0 for photographs without points."""
    gains = torch.zeros(len(logs), 3)
    if logs.shape[1] == 0:
        return gains
    for _ in range(SWEEPS):
        colors = _median(logs - gains[:, None], 0)
        gains = _median(logs - colors, 1).nan_to_num(0.0)
        gains -= gains.mean(0)
    return gains


def _disagreement(logs: Tensor) -> float:
    """Compute the median deviation of the observations from their point's median."""
    apart = (logs - _median(logs, 0)).abs()
    return float(_median(apart[apart.isfinite()], 0))


def _median(values: Tensor, dim: int) -> Tensor:
    """Compute the median along a dimension without NaN, the mean of the middle two for even counts; NaN if empty.
    torch's lower median would be biased."""
    if values.shape[dim] == 0:
        return torch.full_like(values.sum(dim), math.nan)
    return 0.5 * (values.nanmedian(dim).values - (-values).nanmedian(dim).values)
