"""Ranges of the training options."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest

from bitymi_ns.train.config import LearningRates, TrainConfig
from bitymi_ns.train.options import RANGES, check_ranges
from bitymi_ns.train.schedules import Schedule


def with_option(name: str, value: Any) -> TrainConfig:
    config, (group, _, rest) = TrainConfig(), name.partition(".")
    if not rest:
        return replace(config, **{group: value})
    return replace(config, **{group: replace(getattr(config, group), **{rest: value})})


@pytest.mark.parametrize("name", RANGES)
def test_every_range_is_kept(name: str) -> None:
    low, high = RANGES[name]
    check_ranges(with_option(name, low))
    for value in (low - 1, math.nan, *([2 * high + 1] if math.isfinite(high) else [])):
        with pytest.raises(ValueError, match=f"^{name} must be .* not "):
            Schedule(with_option(name, value), 100)


def test_every_number_has_a_range() -> None:
    def numbers(config: Any, before: str = "") -> set[str]:
        found = set()
        for f in fields(config):
            value = getattr(config, f.name)
            if is_dataclass(value):
                found |= numbers(value, f"{before}{f.name}.")
            elif isinstance(value, (int, float)):
                found.add(before + f.name)
        return found

    rates = {f"lr.{f.name}" for f in fields(LearningRates) if not f.name.startswith("short_run")}  # Schedule.lr
    steps = {"loss.overdraw_start", "loss.overdraw_stop", "densify.start", "densify.stop", "seed"}  # any will do
    assert numbers(TrainConfig()) - rates - steps == set(RANGES)
