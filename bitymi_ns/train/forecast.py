"""Estimates of the surfels of a run, and of the time that is left by its steps so far."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from .schedules import Schedule

Steps = npt.NDArray[np.float64]
"""A number for each step of a run."""

GROWTH = 1.19  # of the surfels per densification, on the captures of docs/training.md
SURFELS_PER_PIXEL = 0.4  # of a view, at which their number hardly grows any more
KEPT = 0.7  # part of the surfels that the error prune leaves
SURFEL = 1.5  # cost of a surfel in a step, relative to that of a pixel
TEXELS = 1.5  # cost of a step with texels, relative to one without
DRAWN = 0.5  # cost of a view that is drawn only, relative to a step
WARM = 2  # first steps of a run, which are slower
ENOUGH, PATIENCE = 20, 10.0  # steps, or seconds, after which the estimate is stated
RECENT = 100  # steps of the exponential averages of times


def expected_surfels(schedule: Schedule, first: int, pixels: float, most: int = 0) -> Steps:
    """Estimate the number of surfels in each step of a run that starts with `first`. `pixels`: of a view at full size.
    `most`: `Strategy.most`."""
    given = schedule.config.densify.max_surfels
    limit = given or max(first, min(most or np.inf, SURFELS_PER_PIXEL * pixels))
    factors = np.ones(schedule.max_steps)
    growth = (limit / max(1, first)) ** (1 / max(1, len(schedule.densify_steps))) if given else GROWTH
    factors[list(schedule.densify_steps)] = growth
    surfels = np.minimum(first * factors.cumprod(), limit)
    for step in schedule.error_prune_steps:
        surfels[step:] *= KEPT
    return surfels


class Forecast:
    """Time that a run will still take. A step costs in proportion to its pixels and surfels, in all views that it
    draws; a unit of this cost takes as long as in the last steps, scaled by sizes of pictures (`compare_sizes`).

    Attributes:
        left: seconds to the end of the run; None before the first steps.
        settled: `left` is of enough steps to be stated.
    """

    def __init__(
        self,
        schedule: Schedule,
        views: int,
        pixels: float,
        surfels: Steps,
        evaluated: Mapping[int, int],
        first: int = 0,
        on_gpu: bool = False,
    ) -> None:
        """
        Args:
            views: number of training views.
            pixels: mean of a view at full size.
            surfels: in each step (`expected_surfels`).
            evaluated: number of views evaluated, by step.
            first: step with which the run begins, or goes on.
            on_gpu: small pictures take as long as large ones.
        """
        steps = schedule.max_steps
        sizes = np.array([1.0 if on_gpu else schedule.resolution_factor(step) for step in range(steps)])
        of_step = np.where(np.arange(steps) >= schedule.texels_start, TEXELS, 1.0)
        at_full_size = np.zeros(steps)
        of_step[list(schedule.densify_steps)] += DRAWN * min(views, schedule.config.densify.views)
        of_step[list(schedule.error_prune_steps)] += min(views, schedule.error_views)
        of_step[list(schedule.final_prune_steps)] += min(views, schedule.final_views)
        if schedule.texels_start < steps:
            at_full_size[schedule.texels_start] += DRAWN * min(views, schedule.survey_views)
        for step, count in evaluated.items():
            at_full_size[step] += DRAWN * count
        self._of_step, self._at_full_size = of_step, at_full_size
        self._sizes = sizes
        self._pixels = pixels
        self._surfels = surfels
        self._measured, self._times = np.zeros(1), np.ones(1)  # logarithms of sizes, relative times of a unit
        self._beside = 0.0  # units that a step costs beside its views
        self._begin, self._warm = (0.0, 0.0), first + WARM
        self._seconds = self._cpu = self._steps = self._done = 0.0  # of the last steps: times, their number and units
        self._plan()
        self.left: float | None = None
        self.settled = False

    def _plan(self) -> None:
        self._units = self._cost()
        self._after = self._units[::-1].cumsum()[::-1] - self._units

    def _cost(self, side: float = 1.0) -> Steps:
        """Compute the cost of each step, of pictures with `side` times longer sides."""

        def of_view(sizes: Steps | float) -> Steps:
            longer = np.interp(np.log(side * sizes), self._measured, self._times)
            return longer * ((side * sizes) ** 2 * self._pixels + SURFEL * self._surfels)

        return self._of_step * of_view(self._sizes) + self._at_full_size * of_view(1.0) + self._beside

    def compare_sizes(self, step: int, seconds: Mapping[float, float]) -> None:
        """Let steps at other sizes take as long as measured: with longer fragment lists, whose memory comes from the
        system in every step or which are made in bands, a fragment can take twice as long.

        Args:
            step: at which they were measured.
            seconds: CPU seconds of a view in a step, by factor of the sides of pictures, that of this step included.
        """
        sizes = np.array(sorted(seconds))
        beside = max(0.0, self._cpu / self._steps - seconds[self._sizes[step]])
        units = sizes**2 * self._pixels + SURFEL * self._surfels[step]
        times = np.array([seconds[size] for size in sizes]) / units
        self._measured = np.log(sizes)
        self._times = times / times[-1]
        self._beside = beside / times[-1]
        before = self._units[step]
        self._plan()
        self._done *= self._units[step] / before
        self._estimate(step)

    def begin(self) -> None:
        self._begin = time.perf_counter(), time.process_time()

    def end(self, step: int) -> None:
        """Count the time since `begin` for a step."""
        if step >= self._warm:
            fade = 1.0 - 1.0 / RECENT
            self._seconds = fade * self._seconds + time.perf_counter() - self._begin[0]
            self._cpu = fade * self._cpu + time.process_time() - self._begin[1]
            self._steps = fade * self._steps + 1.0
            self._done = fade * self._done + self._units[step]
            self._estimate(step)
            steps = step + 1 - self._warm
            self.settled = steps >= ENOUGH or (steps > 1 and self._seconds > PATIENCE)

    def _estimate(self, step: int) -> None:
        self.left = float(self._seconds / self._done * self._after[step])

    def half(self) -> float:
        """Compute the factor of the pictures' sides at which the whole run takes half as long; 0 if none does."""
        low = 0.0
        high = 1.0
        wanted = 0.5 * self._units.sum()
        for _ in range(20):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._cost(middle).sum() <= wanted else (low, middle)
        return low if low > 0.01 else 0.0  # surfels alone take more
