"""Ranges of the training options."""

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_type_hints

import pytest

from bitymi_ns.ranges import check_ranges
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.schedules import Schedule

UNBOUNDED = {"loss.overdraw_start", "loss.overdraw_stop", "densify.start", "densify.stop", "seed"}


def numbers(config: Any, before: str = "") -> dict[str, bool]:
    """Map every numeric option to whether it has a range."""
    hints, found = get_type_hints(type(config), include_extras=True), {}
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            found |= numbers(value, f"{before}{f.name}.")
        elif isinstance(value, (int, float)):
            found[before + f.name] = hasattr(hints[f.name], "__metadata__")
    return found


def test_every_number_has_a_range() -> None:
    assert {name for name, ranged in numbers(TrainConfig()).items() if not ranged} == UNBOUNDED
    check_ranges(TrainConfig())


@pytest.mark.parametrize("value", [-2, math.nan, 10**10])
@pytest.mark.parametrize(
    "name",
    ["loss.ssim_weight", "densify.importance", "texels.largest", "num_downscales", "init_opacity", "first_surfels"],
)
def test_a_number_out_of_its_range_is_named(name: str, value: float) -> None:
    config, (group, _, rest) = TrainConfig(), name.partition(".")
    changed = replace(getattr(config, group), **{rest: value}) if rest else value
    with pytest.raises(ValueError, match=f"^{name} must be .*, not {value}"):
        Schedule(replace(config, **{group: changed}), 100)
