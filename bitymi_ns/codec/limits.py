"""Limits of the values in a bundle, far beyond what training reaches. They keep every number of a renderer finite and
every channel of a picture at most `BRIGHTEST`."""

import torch
from torch import Tensor

from bitymi_ns.ops.parameters import Limit, Tensors
from bitymi_ns.ops.view_kinds import COLOR_LIMIT, PARAMETERS, VIEW_COLORS

RESIDUAL_LIMIT = 256.0  # largest absolute value of a residual colour
ALPHA_ONE = 128  # byte of an alpha of 1
ALPHA_SCALE = 255 / ALPHA_ONE  # alpha of a texel whose byte is 255
ALPHA_LIMIT = 2.0  # largest alpha
BRIGHTEST = 1e4  # bound of a rendered channel: a base colour, 32 lobes and a residual
EXTENTS = (1e-6, 16.0)  # half sides of tiles in scale units
UNIT_SLACK = 0.01  # tolerance of the length of a stored rotation

LIMITS: dict[str, Limit] = {
    **{name: parameter.limit for name, parameter in PARAMETERS.items()},
    "view_base": (COLOR_LIMIT,),
    "mean_residual": (RESIDUAL_LIMIT,),
}
"""Largest absolute value of a parameter: one number, or one for each entry of its last axis."""


def limit_of(name: str, kind: str) -> Limit:
    """Return the largest absolute values of a parameter or of view_terms, as in `LIMITS`; else infinite."""
    return VIEW_COLORS[kind].reduced_limit if name == "view_terms" else LIMITS.get(name, (float("inf"),))


def beyond(name: str, kind: str, values: Tensor) -> Tensor:
    """Compute the mask of `values`, [N] or [N, ...], beyond the limit of their parameter."""
    largest = limit_of(name, kind)
    most = torch.tensor(largest, device=values.device, dtype=torch.float32) if values.dim() > 1 else largest[0]
    return values.abs() > most


def within(surfels: Tensors, kind: str) -> Tensor:
    """Compute the mask [N] of surfels whose parameters [N, ...] all keep their limits."""
    bad = [beyond(name, kind, value.detach()) for name, value in surfels.items()]
    return ~torch.stack([mask.unsqueeze(-1).flatten(1).any(1) for mask in bad]).any(0)
