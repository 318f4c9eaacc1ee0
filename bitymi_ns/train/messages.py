"""Messages about limits of a run, and options that differ from the recorded ones."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from bitymi_ns.scene.config import SceneConfig
from .config import REFERENCE_STEPS, TrainConfig
from .init import PointReport, default_table_size, table_size_of
from .memory import FILLED
from .schedules import Schedule


def short_run(schedule: Schedule, views: int, field: bool = True, at_once: int = 1) -> list[str]:
    """Describe the short-run rules in force, and warn if the run does not see every photograph. `at_once`: views per
    step."""
    said = []
    if schedule.short_run_gain > 1.0:
        parts = [f"surfels learn {schedule.short_run_gain:.1f} times as fast"]
        densify, resets = sorted(schedule.densify_steps), len(schedule.reset_steps)
        apart = f", {densify[1] - densify[0]} steps apart" if len(densify) > 1 else ""
        parts.append(f"{_count(len(densify), 'densification')}{apart}, {_count(resets, 'opacity reset')}")
        if field and schedule.freeze_every < schedule.config.freeze_every:
            rare = f"learns on 1 of {schedule.freeze_every} steps once it is frozen"
            parts.append(f"the texture field {rare if schedule.freeze_every > 1 else 'is never frozen'}")
        said.append(f"Rules for runs of fewer than {REFERENCE_STEPS:,} steps: {'; '.join(parts)}.")
    seen = schedule.max_steps * at_once
    if seen < views:
        said.append(
            f"A run of {schedule.max_steps:,} steps sees {seen:,} of the {views:,} training photographs: raise "
            "--max-num-iterations."
        )
    return said


def warnings_at_start(points: PointReport, config: TrainConfig, image_pixels: int, scene: SceneConfig) -> list[str]:
    """Describe the limits that the initial scene hits. `image_pixels`: total over all training images."""
    said = []
    if points.over_cap:
        most, first = config.densify.max_surfels, config.first_surfels
        by_steps = first is not None and (most <= 0 or first < most)
        option, most = ("pipeline.model.train.first-surfels", first) if by_steps else ("max-surfels", most)
        what = f"{points.random:,} random points" if points.random else f"{points.given:,} points of the capture"
        said.append(
            f"Training starts from {most:,} surfels: {points.over_cap:,} of {what} are left out at random (--{option})."
        )
    size = default_table_size(image_pixels)
    if scene.texture == "hash" and scene.log2_table_size is None and table_size_of(image_pixels) > size:
        said.append(
            f"The texture field gets 2^{size} entries per level, the default's maximum; the photographs could fill "
            f"2^{table_size_of(image_pixels)} (--pipeline.model.scene.log2-table-size)."
        )
    return said


def held_back(count: int, most: int, config: TrainConfig) -> str:
    """Report that densification wanted `count` surfels more than the limit `most`."""
    densify = config.densify
    return (
        f"Densification stops at {most:,} surfels, one for {densify.pixels_per_surfel:g} pixels of all photographs or "
        f"{densify.growth:g} times the first, and would have made {count:,} more (--max-surfels, "
        "--pipeline.model.train.densify.pixels-per-surfel, growth)."
    )


def memory_reached(what: str, most: int) -> str:
    """Report that memory has stopped the growth of `what` ("Surfels") at a number of them."""
    return (
        f"{what} stop growing at {most:,}, as {FILLED:.0%} of the memory is used up; the run goes on. For more, end "
        "other programs or train smaller photographs (--pipeline.datamanager.longest-side)."
    )


def recorded(config: TrainConfig) -> str:
    """Serialise the training options as JSON for a checkpoint."""
    return json.dumps(asdict(config), sort_keys=True)


NEW = "new in this version"


def other_options(record: str | None, config: TrainConfig) -> list[str]:
    """List the options `config` of a resumed run that differ from the recorded ones. `record`: of `recorded`; None in
    checkpoints of earlier versions."""
    if record is None:
        return []
    before, now = (dict(_flat(json.loads(text))) for text in (record, recorded(config)))
    different = [name for name in now if before.get(name, NEW) != now[name]]
    if not different:
        return []
    was = {name: f"was {before[name]}" if name in before else NEW for name in different}
    named = ", ".join(f"{name.replace('_', '-')} {now[name]} ({was[name]})" for name in different)
    return [f"Resumed with other options than were recorded (--pipeline.model.train): {named}."]


def _flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in options.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _count(n: int, name: str) -> str:
    return f"{n or 'no'} {name}{'' if n == 1 else 's'}"
