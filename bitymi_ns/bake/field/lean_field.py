"""Removal of the levels of a field that a scene does not need."""

from collections.abc import Mapping

import torch
from torch import Tensor

from bitymi_ns.bundle.statistics import FieldLevels
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.field import field as evaluate
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.tile_sizes import kernel_parameters
from bitymi_ns.train.init import tangents

LEVEL_SHARE = 0.1  # levels are left out while they change the residual by no more than this share of the tolerance
POINTS = 16  # points per surfel at which the field is evaluated
_CHUNK = 1 << 19


@torch.no_grad()
def level_changes(
    field: HashField,
    surfels: Mapping[str, Tensor],
    left_out: list[tuple[int, ...]],
    transmittance: Tensor | None = None,
    weight_bound: float = 0.0,
) -> Tensor:
    """Measure every surfel's change of residual without some levels, 8-bit steps.

    Root mean square over points of the kernel's support (even over the disc, the same for every surfel) and the
    channels, of the change times the largest blending weight there: the measure of the tiles' tolerance. Points whose
    weight stays below `weight_bound` get no residual and are not counted.

    Args:
        surfels: per-surfel parameters, N rows.
        transmittance: [N] of `Visibility`, None = 1.
        weight_bound: fragments of smaller weight get no residual.

    Returns:
        [sets, N].
    """
    means = surfels["means"]
    opacity, beta = kernel_parameters(surfels, transmittance)
    edges = tangents(surfels["quats"]) * surfels["log_scales"].exp()[:, None]
    g = torch.Generator().manual_seed(0)
    radius, angle = SUPPORT * torch.rand(POINTS, generator=g).sqrt(), 2 * torch.pi * torch.rand(POINTS, generator=g)
    uv = torch.stack([radius * angle.cos(), radius * angle.sin()], dim=1).to(means)  # [P, 2]
    table, w1, w2, w3 = field.weights
    changes = means.new_zeros(len(left_out), len(means))
    for rows in torch.arange(len(means), device=means.device).split(_CHUNK // POINTS):
        x = (means[rows, None] + uv @ edges[rows].transpose(1, 2)).reshape(-1, 3)
        rest = (1 - radius.to(means).square() / SUPPORT**2).clamp(min=1e-12)
        weight = opacity[rows, None] * rest ** beta[rows, None]  # [n, P]
        weight = torch.where(weight >= weight_bound, weight, 0.0)
        count = 3 * (weight > 0).sum(1).clamp(min=1)
        whole = evaluate(x, field.geometry, table, w1, w2, w3)
        for i, levels in enumerate(left_out):
            less = w1.clone()  # rows of the first layer that are 0 are features that are 0
            for level in levels:
                less[level * table.shape[2] : (level + 1) * table.shape[2]] = 0
            change = (evaluate(x, field.geometry, table, less, w2, w3) - whole).view(len(rows), POINTS, 3)
            square = (change.square().sum(2) * weight.square()).sum(1)
            changes[i, rows] = STEPS * (square / count).sqrt()
    return changes


def lean_field(
    field: HashField, surfels: Mapping[str, Tensor], transmittance: Tensor | None, weight_bound: float, tolerance: float
) -> tuple[HashField, FieldLevels]:
    """Remove the finest and coarsest levels of a field, as far as no surfel needs them.

    The levels that stay are consecutive, so they are a field again. The finest levels are left out first, then the
    coarsest, as long as all that is left out together changes no surfel (`level_changes`) by more than LEVEL_SHARE of
    the tolerance.

    Args:
        surfels: per-surfel parameters, N rows.
        transmittance: [N] of `Visibility`, None = 1.
        weight_bound: fragments of smaller weight get no residual.

    Returns:
        the field, and what was left out.
    """
    every = range(field.levels)
    at = (surfels, [(level,) for level in every], transmittance, weight_bound)
    single = [round(float(change), 4) for change in level_changes(field, *at).amax(1)]
    first, end, change = 0, field.levels, 0.0
    while end - first > 1:
        for lower, upper in ((first, end - 1), (first + 1, end)):
            gone = tuple(level for level in every if not lower <= level < upper)
            together = float(level_changes(field, surfels, [gone], transmittance, weight_bound).amax())
            if together <= LEVEL_SHARE * tolerance:
                first, end, change = lower, upper, together
                break
        else:
            break
    kept = field if end - first == field.levels else field.only(first, end - first)
    return kept, FieldLevels(
        unit="8-bit steps, weighted root mean square over a surfel, largest of all surfels",
        levels=field.levels,
        kept=(first, end - first),
        change_of_each=single,
        change=round(change, 4),
        tolerance=round(LEVEL_SHARE * tolerance, 6),
    )
