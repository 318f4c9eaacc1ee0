"""Which values the files of a bundle may hold.

Far beyond what training reaches (an optimiser moves a parameter by at most its learning rate per step), and close
enough that every number a renderer computes is finite and no channel of a picture exceeds `BRIGHTEST`.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

COLOR_LIMIT = 256.0
"""Largest absolute value of a colour, a coefficient or the colour of a lobe, 1 = white."""
RESIDUAL_LIMIT = 256.0
"""Largest absolute value of a residual colour."""
BRIGHTEST = 1e4
"""No channel of a rendered picture exceeds this: a base colour, 32 lobes and a residual."""
EXTENTS = (1e-6, 16.0)
"""Half sides of tiles in scale units."""
UNIT_SLACK = 0.01
"""How far the length of a stored rotation may be from 1."""

_SHAPE = 1e4  # logits, angles, log sharpness: sigmoid and exp have long reached their ends
_DIRECTION = 1e6  # of any length: the renderers normalise
_VECTOR = 2e7  # differences of two temperatures of at most exp(16) times a direction
_BETA_LOBE = (*[COLOR_LIMIT] * 3, *[_SHAPE] * 3)
_GAUSSIAN_LOBE = (*[_DIRECTION] * 3, _SHAPE, *[COLOR_LIMIT] * 3)

LIMITS: dict[str, tuple[float, ...]] = {
    "means": (1e9,),
    "log_scales": (104.0,),  # beyond, exp() is 0 or infinite in float32
    "opacity_logits": (_SHAPE,),
    "beta_raw": (_SHAPE,),
    "sv_sites": (_DIRECTION,),
    "sv_log_tau": (_SHAPE,),
    "sv_rgb": (COLOR_LIMIT,),
    "sh_dc": (COLOR_LIMIT,),
    "sh_rest": (COLOR_LIMIT,),
    "sb_base": (COLOR_LIMIT,),
    "sb_lobes": _BETA_LOBE,
    "sg_base": (COLOR_LIMIT,),
    "sg_lobes": _GAUSSIAN_LOBE,
    "view_base": (COLOR_LIMIT,),
    "mean_residual": (RESIDUAL_LIMIT,),
}
"""Largest absolute value of a parameter, one for all its numbers or one for each along its last axis."""
TERM_LIMITS: dict[str, tuple[float, ...]] = {
    "sv": (*[_VECTOR] * 3, *[COLOR_LIMIT] * 3),
    "sh": (COLOR_LIMIT,),
    "sb": _BETA_LOBE,
    "sg": _GAUSSIAN_LOBE,
}
"""The same of the terms of lean view colours (`view_terms`), by kind."""


def beyond(name: str, kind: str, values: Tensor) -> Tensor:
    """Which numbers of a parameter are beyond its limit: bool of the shape of `values`.

    Args:
        name: a parameter of the surfels, or mean_residual; one without a limit is never beyond it.
        kind: sv, sh, sb or sg.
        values: [N] or [N, ...].
    """
    largest = TERM_LIMITS[kind] if name == "view_terms" else LIMITS.get(name, (float("inf"),))
    return values.abs() > (torch.tensor(largest, device=values.device) if values.dim() > 1 else largest[0])


def within(surfels: Mapping[str, Tensor], kind: str) -> Tensor:
    """Which surfels may be stored, [N] bool: their parameters, of which all have a row per surfel, keep the limits."""
    bad = [beyond(name, kind, value.detach()) for name, value in surfels.items()]
    return ~torch.stack([each.flatten(1).any(1) if each.dim() > 1 else each for each in bad]).any(0)
