"""Schedules of a run: events, learning rates, resolution."""

import math
from dataclasses import replace

from bitymi_ns.ops.view_kinds import VIEW_PARAMETERS
from bitymi_ns.ranges import check_ranges
from bitymi_ns.train.config import REFERENCE_STEPS, TrainConfig

PATIENT_STEPS = 3000  # steps of a run from which it has time for full size as early as the options say


class Schedule:
    """Events and rates of a run of `max_steps` steps.

    The options give every step count for a run of 30,000 steps. A run of another length keeps the proportions: an
    event that fires n times in 30,000 steps fires n times in any run with room for it, at the same share of the run.
    Densifications and opacity resets keep a least distance in steps (`min_interval`, `min_reset_interval`) and so fire
    less often in short runs.

    `step` is the index of a training step, 0 to max_steps - 1. Events take place after that step's optimiser update.
    """

    def __init__(
        self, config: TrainConfig, max_steps: int, extent: float = 1.0, texels: bool = False, pixels: float = 0.0
    ) -> None:
        """
        Args:
            max_steps: length of the run in steps.
            extent: scene extent in world units.
            texels: whether texels learn in the last part of the run.
            pixels: of a photograph that show something, on average.
        """
        if max_steps < 1:
            raise ValueError(f"a run needs at least one step, not {max_steps}")
        if not (math.isfinite(extent) and extent > 0.0):
            raise ValueError(f"the scene extent must be positive and finite, not {extent}")
        self.config = config
        self.max_steps = max_steps
        self.extent = float(extent)
        densify = config.densify
        check_ranges(config)
        # short runs leave events out, so that about the least number of steps lies between two
        reset = densify.reset_interval * self._stride(densify.reset_interval, densify.min_reset_interval)
        interval = densify.interval * self._stride(densify.interval, densify.min_interval)
        self.texels_start = min(max_steps, self.scaled(config.texels.start)) if texels else max_steps
        stop = min(densify.stop, config.texels.start) if texels else densify.stop
        # after these steps surfels are cloned, split and pruned; opacities reset; surfels that hardly matter, and those
        # that are transparent, pruned
        self.densify_steps = self._events(_multiples(interval, densify.start, stop))
        self.reset_steps = self._events(_multiples(reset, 0, stop))
        self.reset_every = self.scaled(reset)
        prunes = densify.prune_error > 0 and 0 < stop < REFERENCE_STEPS
        self.error_prune_steps = self._events([stop] if prunes else [])
        self.final_prune_steps = self._events([s for s in densify.final_prune_steps if 0 < s <= REFERENCE_STEPS])
        self._doublings = self._image_doublings(pixels)
        self._last_part: Schedule | None = None
        if self.texels_start < max_steps:
            slower = config.lr.times(config.texels.surfel_rates)
            slower.mean_pixels = config.lr.times(config.texels.mean_rates).mean_pixels
            self._last_part = Schedule(replace(config, lr=slower), self.texel_steps, extent)

    @property
    def in_pixels(self) -> bool:
        """True where the rate of the means is in pixels, see `step_sizes`; in world units otherwise."""
        return self.config.lr.means is None

    @property
    def texel_steps(self) -> int:
        """Steps in which texels learn."""
        return self.max_steps - self.texels_start

    @property
    def short_run_gain(self) -> float:
        """Factor of the surfels' learning rates: more than 1 in runs of fewer than 30,000 steps.

        Adam moves a parameter by about its rate per step, so a run of 600 steps at the published rates ends long before
        the surfels have settled.
        """
        shortness = max(1.0, REFERENCE_STEPS / self.max_steps)
        return min(self.config.lr.short_run_max, shortness**self.config.lr.short_run_power)

    def scaled(self, step_at_30k: float) -> int:
        """The step count of this run that corresponds to one given for 30,000 steps: 0 stays 0, all else at least 1."""
        if step_at_30k <= 0:
            return 0
        return max(1, math.floor(step_at_30k * self.max_steps / REFERENCE_STEPS + 0.5))

    def _stride(self, interval: int, least: int) -> int:
        return max(1, round(least * REFERENCE_STEPS / (interval * self.max_steps)))

    def _events(self, steps_at_30k: list[int]) -> frozenset[int]:
        return frozenset(min(self.scaled(s), self.max_steps - 1) for s in steps_at_30k)

    def reset_opacity(self) -> float:
        """Opacity that a reset lowers to: `reset_opacity`, or more in a short run.

        Adam moves a logit by no more than its learning rate per step. So a reset lowers opacities only as far as they
        can rise again in half the time to the next reset. Otherwise a short run would never have an opaque surfel, and
        its final prunes would remove nearly all. This matters where resets are less than about 370 steps apart (fewer
        with the rates of a short run).
        """
        densify = self.config.densify
        deepest = max(-500.0, -0.5 * self.reset_every * self.lr("opacity_logits", 0))  # exp() overflows beyond
        return max(densify.reset_opacity, 1.0 / (1.0 + math.exp(-deepest)))

    def recovering(self, step: int) -> bool:
        """True where the last opacity reset may still show: half of the time to the next one is not over."""
        return any(reset < step <= reset + max(1, self.reset_every // 2) for reset in self.reset_steps)

    def overdraw_counts(self, step: int) -> bool:
        """True where the overdraw loss is part of this step's objective."""
        loss = self.config.loss
        return loss.overdraw_weight > 0.0 and (
            self.scaled(loss.overdraw_start) <= step < self.scaled(loss.overdraw_stop)
        )

    def geometry_counts(self, step: int) -> bool:
        """True where the depth and the normal loss are part of this step's objective, if the view has such maps."""
        loss = self.config.loss
        return max(loss.depth_weight, loss.normal_weight) > 0.0 and step % loss.geometry_interval == 0

    def lists_fragments(self, maps: bool) -> bool:
        """True where a step needs lists of fragments on a card, too: for the overdraw loss, or with depth or normals.

        Args:
            maps: there are views with depth or normals.
        """
        loss = self.config.loss
        return loss.overdraw_weight > 0.0 or maps and max(loss.depth_weight, loss.normal_weight) > 0.0

    def densification_over(self, step: int) -> bool:
        """True where no densification can follow this step, so that its statistics are needed no more."""
        return not self.densify_steps or step > max(self.densify_steps)

    def field_trains(self, step: int) -> bool:
        """True where the texture learns in this step; on the other steps it is evaluated without gradient.

        From `freeze_after` on it learns in one step in `freeze_every` (section Training Time of the paper). A run of
        few steps freezes less often: it could not learn a texture in a tenth of them. Texels learn in every step of
        theirs.
        """
        return self.texels_learn(step) or step < self.scaled(self.config.freeze_after) or step % self.freeze_every == 0

    @property
    def freeze_every(self) -> int:
        """After `freeze_after` the field learns in one step in so many."""
        left = self.max_steps - self.scaled(self.config.freeze_after)
        return max(1, min(self.config.freeze_every, left // max(1, self.config.freeze_min_updates)))

    def texels_learn(self, step: int) -> bool:
        """True where every surfel has its own texels in this step, and they learn."""
        return step >= self.texels_start

    def texel_rate(self, step: int, views: int = 1) -> float:
        """Rate of the texels in a step in which they learn.

        It falls to 0 as a cosine, so texels can move half as far as they would at its start. Few passes over the views
        at `rate` would end before the texels are where the photographs want them.
        """
        texels = self.config.texels
        needed = 2.0 * texels.travel * views / self.texel_steps
        return max(texels.rate, min(needed, texels.travel)) * self._falling(step)

    def pose_pixels(self, step: int) -> float:
        """Length of a step of a photograph's pose, pixels; 0 where poses stay."""
        poses = self.config.poses
        first, last = self.scaled(poses.start), self.scaled(poses.stop)
        if self.config.refine_poses == "off" or not first <= step < last:
            return 0.0
        return falling(poses.pixels, step - first, last - first)

    def _falling(self, step: int) -> float:
        return falling(1.0, step - self.texels_start, self.texel_steps)

    def resolution_factor(self, step: int) -> float:
        """Factor of the image size, 2^-k; 1 from the last doubling on."""
        return 2.0 ** -sum(step < at for at in self._doublings)

    def _image_doublings(self, pixels: float) -> list[int]:
        """Steps from which the image size is doubled, `resolution_schedule` apart.

        Short runs whose texels learn in a last part of their own wait longer, by `short_run_gain`, though full size
        comes with the texels at the latest: what the surfels need to know before, smaller pictures show for less.
        Photographs that are small themselves, or show something in few of their pixels, show too little then, and
        their runs wait less: by the square root of these pixels over `small_photograph`. Longer runs learn more than
        smaller pictures show: from about 1,850 steps on they wait less, from `PATIENT_STEPS` on not at all.
        """
        apart, count = self.config.resolution_schedule, self.config.num_downscales
        if apart <= 0 or count <= 0:
            return []
        if self.texels_start < self.max_steps:
            by_pixels = math.sqrt(pixels / self.config.small_photograph)
            wait = min(self.short_run_gain, by_pixels, (PATIENT_STEPS / self.max_steps) ** 2)
            apart = max(apart, min(apart * wait, self.config.texels.start / count))
        return [self.scaled(apart * (i + 1)) for i in range(count)]

    def lr(self, name: str, step: int) -> float:
        """Learning rate of a parameter in this step; of the means in pixels, if `in_pixels`.

        Args:
            name: a surfel parameter, field_table, field_mlp or exposure.
        """
        rates, gain = self.config.lr, self.short_run_gain
        if self._last_part is not None and self.texels_learn(step) and not name.startswith(("field", "exposure")):
            return self._last_part.lr(name, 0) * self._falling(step)
        warmup = min(1.0, (step + 1) / max(1, self.scaled(self.config.field_warmup)))
        factor = warmup if name.startswith("field") else gain
        if name == "means" and self.in_pixels:
            name = "mean_pixels"
        elif name == "means":
            factor *= self.extent
        if name in VIEW_PARAMETERS:
            factor, name = factor * VIEW_PARAMETERS[name].share, VIEW_PARAMETERS[name].rate
        rate = getattr(rates, name)
        if not isinstance(rate, tuple):
            return factor * float(rate)
        t = min(max(step / max(1, self.max_steps - 1), 0.0), 1.0)  # log-linear from the first rate to the second
        return factor * math.exp((1.0 - t) * math.log(rate[0]) + t * math.log(rate[1]))


def falling(rate: float, step: int, steps: int) -> float:
    """A rate that falls to 0 as a cosine."""
    return rate * 0.5 * (1.0 + math.cos(math.pi * step / steps))


def _multiples(interval: int, start: int, stop: int) -> list[int]:
    """Multiples of `interval` strictly between `start` and `stop`."""
    return [s for s in range(interval, stop, interval) if s > start]
