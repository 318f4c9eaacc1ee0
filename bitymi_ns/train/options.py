"""The ranges of the training options."""

from __future__ import annotations

import math
from typing import Any

from bitymi_ns.train.config import TrainConfig

MOST = 1e9
"""Largest value of any option that has no bound of its own."""
TINY = 1e-9
"""Smallest value of an option that must be more than 0."""
RANGES: dict[str, tuple[float, float]] = {
    "loss.ssim_weight": (0, 1),
    "loss.falloff_weight": (0, MOST),
    "loss.falloff_gamma": (0, MOST),
    "loss.overdraw_weight": (0, MOST),
    "loss.overdraw_half": (TINY, MOST),
    "densify.interval": (1, MOST),
    "densify.views": (1, MOST),
    "densify.error_threshold": (0, 1),
    "densify.importance": (-1, MOST),
    "densify.grad_threshold": (0, math.inf),
    "densify.abs_grad_threshold": (0, math.inf),
    "densify.dense": (0, math.inf),
    "densify.prune_opacity": (0, 1),
    "densify.prune_world": (0, math.inf),
    "densify.prune_screen": (0, math.inf),
    "densify.prune_budget": (0, 1),
    "densify.opacity_clamp": (TINY, 1),
    "densify.reset_interval": (1, MOST),
    "densify.min_reset_interval": (0, MOST),
    "densify.reset_opacity": (TINY, 1),
    "densify.final_prune_opacity": (0, 1),
    "densify.final_prune_score": (0, math.inf),
    "densify.min_interval": (0, MOST),
    "densify.pixels_per_surfel": (0, MOST),
    "densify.growth": (0, MOST),
    "densify.max_surfels": (0, MOST),
    "densify.min_surfels": (0, MOST),
    "lr.short_run_power": (0, 10),
    "lr.short_run_max": (TINY, MOST),
    "guard.rollbacks": (0, MOST),
    "guard.rates": (TINY, 1),
    "guard.window": (1, MOST),
    "guard.min_window": (1, MOST),
    "texels.start": (0, MOST),
    "texels.rate": (0, MOST),
    "texels.travel": (0, MOST),
    "texels.prior": (TINY, MOST),
    "texels.surfel_rates": (0, MOST),
    "texels.pixels_per_texel": (TINY, MOST),
    "texels.looked_pixels_per_texel": (TINY, MOST),
    "texels.largest": (4, 4096),
    "texels.views": (0, MOST),
    "freeze_after": (0, MOST),
    "freeze_every": (1, MOST),
    "freeze_min_updates": (0, MOST),
    "field_warmup": (0, MOST),
    "resolution_schedule": (0, MOST),
    "small_photograph": (1, MOST),
    "num_downscales": (0, 16),
    "init_opacity": (TINY, 1 - TINY),
    "random_points": (1, MOST),
}
"""Option -> smallest and largest value. Learning rates are checked by the schedule that makes them."""


def check_ranges(config: TrainConfig) -> None:
    """Refuse values that make no sense; NaN is in no range.

    Raises:
        ValueError: names the option, its range and the value.
    """
    for name, (low, high) in RANGES.items():
        value: Any = config
        for part in name.split("."):
            value = getattr(value, part)
        if not low <= value <= high:
            above = "more than 0" if low == TINY else f"at least {low:g}"
            below = "" if high in (MOST, math.inf) else f" and at most {high:g}"
            raise ValueError(f"{name} must be {above}{below}, not {value:g}")
