"""Limits of the values in the files of a bundle.

Far beyond what training reaches (an optimiser moves a parameter by at most its learning rate per step), and close
enough that every number a renderer computes is finite and no channel of a picture exceeds `BRIGHTEST`.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from bitymi_ns.ops.view_kinds import COLOR_LIMIT, SHAPE_LIMIT, VIEW_COLORS, VIEW_PARAMETERS, Limit

RESIDUAL_LIMIT = 256.0  # largest absolute value of a residual colour
ALPHA_ONE = 128  # byte of an alpha of 1
ALPHA_SCALE = 255 / ALPHA_ONE  # alpha of a texel whose byte is 255
ALPHA_LIMIT = 2.0  # largest alpha
BRIGHTEST = 1e4  # no channel of a rendered picture exceeds this: a base colour, 32 lobes and a residual
EXTENTS = (1e-6, 16.0)  # half sides of tiles in scale units
UNIT_SLACK = 0.01  # tolerance of the length of a stored rotation

LIMITS: dict[str, Limit] = {
    "means": (1e9,),
    "log_scales": (104.0,),  # beyond, exp() is 0 or infinite in float32
    "opacity_logits": (SHAPE_LIMIT,),
    "beta_raw": (SHAPE_LIMIT,),
    **{name: parameter.limit for name, parameter in VIEW_PARAMETERS.items()},
    "view_base": (COLOR_LIMIT,),
    "mean_residual": (RESIDUAL_LIMIT,),
}
"""Largest absolute value of a parameter, one for all its numbers or one for each along its last axis."""


def limit_of(name: str, kind: str) -> Limit:
    """Largest absolute values of a parameter, as in `LIMITS`; infinite for one without a limit.

    Args:
        name: a parameter of the surfels, view_terms of lean view colours, or mean_residual.
        kind: a name of `ops.VIEW_COLORS`.
    """
    return VIEW_COLORS[kind].lean_limit if name == "view_terms" else LIMITS.get(name, (float("inf"),))


def beyond(name: str, kind: str, values: Tensor) -> Tensor:
    """Mask of the numbers of a parameter beyond its limit: bool of the shape of `values`.

    Args:
        name, kind: as in `limit_of`.
        values: [N] or [N, ...].
    """
    largest = limit_of(name, kind)
    return values.abs() > (torch.tensor(largest, device=values.device) if values.dim() > 1 else largest[0])


def within(surfels: Mapping[str, Tensor], kind: str) -> Tensor:
    """[N] bool, True for surfels whose parameters, each with a row per surfel, keep the limits."""
    bad = [beyond(name, kind, value.detach()) for name, value in surfels.items()]
    return ~torch.stack([each.flatten(1).any(1) if each.dim() > 1 else each for each in bad]).any(0)
