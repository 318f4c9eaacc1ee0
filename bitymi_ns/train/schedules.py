"""Schedules of a run: events, learning rates, resolution."""

import math
from dataclasses import replace

from bitymi_ns.ops.view_kinds import PARAMETERS
from bitymi_ns.ranges import check_ranges
from .config import REFERENCE_STEPS, TrainConfig

ERROR_VIEWS, FEWEST_ERROR_VIEWS = 0.1, 64
"""Views of the error prune, as a fraction of the run's steps, and their minimum."""
FINAL_VIEWS, FEWEST_FINAL_VIEWS = 0.025, 16  # likewise, for each of the four final prunes
FEWEST_SURVEYED = 32  # minimum number of views to measure tiles on
PATIENT_STEPS = 3000  # runs as long reach full size as early as the options say


class Schedule:
    """Events and learning rates of a run. Step counts of the options are scaled to its length; densifications and
    opacity resets keep a minimum interval and so are fewer in short runs.

    `step` is the index of a training step, 0 to max_steps - 1. Events take place after its optimiser update.

    Attributes:
        in_pixels: the rate of the means is in pixels (`step_sizes`), else in world units.
        short_run_gain: factor of the surfels' learning rates, above 1 in runs of fewer than 30,000 steps: Adam moves a
            parameter by about its rate per step.
        freeze_every: interval of the steps that train the field after `freeze_after`.
        error_views, final_views, survey_views: maximum numbers of views on which the error prune and each final prune
            measure removals, and on which tiles are measured.
        texels_start, texel_steps: first step of the texel stage, and number of its steps.
    """

    def __init__(
        self, config: TrainConfig, max_steps: int, extent: float = 1.0, texels: bool = False, pixels: float = 0.0
    ) -> None:
        """
        Args:
            extent: scene extent, world units.
            texels: the run ends with a texel stage.
            pixels: mean number of opaque, unmasked pixels per photograph.

        Raises:
            ValueError: an argument or option is out of range.
        """
        if max_steps < 1:
            raise ValueError(f"a run needs at least one step, not {max_steps}")
        if not (math.isfinite(extent) and extent > 0.0):
            raise ValueError(f"the scene extent must be positive and finite, not {extent}")
        self.config = config
        self.max_steps = max_steps
        self.extent = float(extent)
        check_ranges(config)
        self._texels, self.pixels = texels, pixels
        self.in_pixels = config.lr.means is None
        shortness = max(1.0, REFERENCE_STEPS / max_steps)
        self.short_run_gain = min(config.lr.short_run_max, shortness**config.lr.short_run_power)
        freezing = max_steps - self.scaled(config.freeze_after)
        self.freeze_every = max(1, min(config.freeze_every, freezing // max(1, config.freeze_min_updates)))
        self.error_views = max(FEWEST_ERROR_VIEWS, round(ERROR_VIEWS * max_steps))
        self.final_views = max(FEWEST_FINAL_VIEWS, round(FINAL_VIEWS * max_steps))
        self.plan()

    def plan(self, begun: int | None = None) -> None:
        """Plan the events of the run. `begun`: step at which the texels of a resumed run began: pictures then have full
        size and no surfel may be added; None: it has none."""
        config, densify = self.config, self.config.densify
        # short runs skip events to keep the minimum interval
        reset = densify.reset_interval * self._stride(densify.reset_interval, densify.min_reset_interval)
        interval = densify.interval * self._stride(densify.interval, densify.min_interval)
        start = self.scaled(config.texels.start) if begun is None else begun
        self.texels_start = min(self.max_steps, start) if self._texels else self.max_steps
        self.texel_steps = self.max_steps - self.texels_start
        self.survey_views = max(FEWEST_SURVEYED, round(config.texels.views * self.texel_steps))
        stop = min(densify.stop, config.texels.start) if self._texels else densify.stop
        # steps after which surfels are densified and pruned, opacities reset, and the error and final prunes run
        before = self.texels_start - 1
        self.densify_steps = self._events(_multiples(interval, densify.start, stop), before)
        self.reset_steps = self._events(_multiples(reset, 0, stop), before)
        self.reset_every = self.scaled(reset)
        prunes = densify.prune_error > 0 and 0 < stop < REFERENCE_STEPS
        self.error_prune_steps = self._events([stop] if prunes else [], self.texels_start)
        self.final_prune_steps = self._events([s for s in densify.final_prune_steps if 0 < s <= REFERENCE_STEPS])
        self._doublings = [] if begun is not None else self._image_doublings(self.pixels)
        self._last_part: Schedule | None = None
        if self.texels_start < self.max_steps:
            slower = config.lr.times(config.texels.surfel_rates)
            slower.mean_pixels = config.lr.times(config.texels.mean_rates).mean_pixels
            self._last_part = Schedule(replace(config, lr=slower), self.texel_steps, self.extent)

    def scaled(self, step_at_30k: float) -> int:
        """Scale a step count for 30,000 steps to this run; at least 1 unless it is 0."""
        if step_at_30k <= 0:
            return 0
        return max(1, math.floor(step_at_30k * self.max_steps / REFERENCE_STEPS + 0.5))

    def _stride(self, interval: int, least: int) -> int:
        return max(1, round(least * REFERENCE_STEPS / (interval * self.max_steps)))

    def _events(self, steps_at_30k: list[int], last: int | None = None) -> frozenset[int]:
        last = self.max_steps if last is None else last
        steps = (min(self.scaled(s), self.max_steps - 1) for s in steps_at_30k)
        return frozenset(step for step in steps if step <= last)

    def reset_opacity(self) -> float:
        """Compute the opacity after a reset: `reset_opacity`, or as much as lets opacities recover in half the time to
        the next reset, as Adam moves a logit by at most its learning rate per step."""
        densify = self.config.densify
        deepest = max(-500.0, -0.5 * self.reset_every * self.lr("opacity_logits", 0))  # exp() overflows beyond
        return max(densify.reset_opacity, 1.0 / (1.0 + math.exp(-deepest)))

    def recovering(self, step: int) -> bool:
        """Return True in the first half of the interval after an opacity reset."""
        return any(reset < step <= reset + max(1, self.reset_every // 2) for reset in self.reset_steps)

    def overdraw_counts(self, step: int) -> bool:
        """Return True if the step has the overdraw loss."""
        loss = self.config.loss
        first, last = self.scaled(loss.overdraw_start), self.scaled(loss.overdraw_stop)
        return loss.overdraw_weight > 0.0 and first <= step < last

    def geometry_counts(self, step: int) -> bool:
        """Return True if the step has depth and normal losses."""
        loss = self.config.loss
        return max(loss.depth_weight, loss.normal_weight) > 0.0 and step % loss.geometry_interval == 0

    def densification_over(self, step: int) -> bool:
        """Return True if no densification follows."""
        return not self.densify_steps or step > max(self.densify_steps)

    def field_trains(self, step: int) -> bool:
        """Return True if the texture is trained in this step; else it is evaluated without gradient. From
        `freeze_after` on a field is trained in one step of `freeze_every` (section Training Time of the paper)."""
        return self.texels_learn(step) or step < self.scaled(self.config.freeze_after) or step % self.freeze_every == 0

    def texels_learn(self, step: int) -> bool:
        return step >= self.texels_start

    def texel_rate(self, step: int, views: int = 1) -> float:
        """Compute the rate of the texels in a step, per pass over `views` views: `rate`, or more if the passes are too
        few to move by `travel`. The cosine decay halves the distance."""
        texels = self.config.texels
        needed = 2.0 * texels.travel * views / self.texel_steps
        return max(texels.rate, min(needed, texels.travel)) * self._falling(step)

    def dropout(self, passes: float) -> float:
        """Compute the probability with which a view leaves a surfel out. `passes`: over the photographs."""
        return self.config.dropout * min(1.0, max(0.0, passes / self.config.dropout_passes - 1.0))

    def pose_pixels(self, step: int) -> float:
        """Compute the length of a pose step, pixels; 0: poses are fixed."""
        poses = self.config.poses
        first, last = self.scaled(poses.start), self.scaled(poses.stop)
        if self.config.refine_poses == "off" or not first <= step < last:
            return 0.0
        return falling(poses.pixels, step - first, last - first)

    def _falling(self, step: int) -> float:
        return falling(1.0, step - self.texels_start, self.texel_steps)

    def resolution_factor(self, step: int) -> float:
        """Compute the factor of the image size, 2^-k."""
        return 2.0 ** -sum(step < doubling for doubling in self._doublings)

    def _image_doublings(self, pixels: float) -> list[int]:
        """List the steps from which the image size is doubled, `resolution_schedule` apart. Short runs with a texel
        stage stretch that interval: smaller images teach the surfels as much at a lower cost. Limits: images of few
        `pixels` show too little, longer runs learn more than small images show, the texel stage needs full size."""
        apart, count = self.config.resolution_schedule, self.config.num_downscales
        if apart <= 0 or count <= 0:
            return []
        if self.texels_start < self.max_steps:
            by_pixels = math.sqrt(pixels / self.config.small_photograph)
            wait = min(self.short_run_gain, by_pixels, (PATIENT_STEPS / self.max_steps) ** 2)
            apart = max(apart, min(apart * wait, self.config.texels.start / count))
        return [self.scaled(apart * (i + 1)) for i in range(count)]

    def lr(self, name: str, step: int) -> float:
        """Compute the learning rate of a surfel parameter, field_table, field_mlp or exposure."""
        rates, gain = self.config.lr, self.short_run_gain
        if self._last_part is not None and self.texels_learn(step) and not name.startswith(("field", "exposure")):
            return self._last_part.lr(name, 0) * self._falling(step)
        warmup = min(1.0, (step + 1) / max(1, self.scaled(self.config.field_warmup)))
        factor = warmup if name.startswith("field") else gain
        if name == "means" and not self.in_pixels:
            factor *= self.extent
        elif name in PARAMETERS:
            factor = factor * PARAMETERS[name].rate_factor
            name = PARAMETERS[name].rate
        rate = getattr(rates, name)
        if not isinstance(rate, tuple):
            return factor * float(rate)
        t = min(max(step / max(1, self.max_steps - 1), 0.0), 1.0)  # log-linear decay
        return factor * math.exp((1.0 - t) * math.log(rate[0]) + t * math.log(rate[1]))


def falling(rate: float, step: int, steps: int) -> float:
    """Compute the cosine decay from `rate` to 0 over `steps` steps."""
    return rate * 0.5 * (1.0 + math.cos(math.pi * step / steps))


def _multiples(interval: int, start: int, stop: int) -> list[int]:
    return [s for s in range(interval, stop, interval) if s > start]
