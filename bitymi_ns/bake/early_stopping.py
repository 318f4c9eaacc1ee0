"""What a descent on the training photographs keeps: the state that shows best the views that it did not learn from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

from torch import Tensor

from bitymi_ns.bundle.statistics import FineTuning, Gain
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.losses import mean_psnr, psnr

S = TypeVar("S")

FEWEST_VIEWS = 4
"""With fewer views none can be set aside: nothing is then learned from them."""


class LookOptions(Protocol):
    """The part of the options that decides when it is looked."""

    steps: int
    checks: int
    patience: int


class Looks(Generic[S]):
    """The looks at the views that were set aside.

    Attributes:
        best: the state that showed them best, the first one where none was better; the last one where no view was set
            aside.
        curve: (step, dB over these views) of every look.
        done: steps before the last look.
    """

    def __init__(self, options: LookOptions, psnr: float, first: S) -> None:
        """
        Args:
            options: see `LookOptions`.
            psnr: of the views before the first step, dB; NaN without any.
            first: the state then.
        """
        self._steps, self._patience = options.steps, options.patience
        self._every = -(-options.steps // options.checks)
        self.best, self.curve, self.done = first, [] if math.isnan(psnr) else [(0, psnr)], 0

    def due(self, done: int) -> bool:
        """Whether it is to be looked after so many steps."""
        return done % self._every == 0 or done == self._steps

    def note(self, done: int, psnr: float, state: Callable[[], S]) -> bool:
        """A look after so many steps.

        Args:
            psnr: of the views, dB; NaN without any.
            state: makes a copy of the state.

        Returns:
            whether more steps are worth it: some of the last looks were no worse than all before.
        """
        self.done = done
        if math.isnan(psnr):
            self.best = state()
            return True
        self.curve.append((done, psnr))
        highest = max(p for _, p in self.curve)
        if psnr == highest:
            self.best = state()
            return True
        return not all(p < highest for _, p in self.curve[-self._patience :])

    def statistics(self, views: int, set_aside: int, seconds: float, cpu_seconds: float) -> FineTuning:
        """What is told of the descent."""
        best_step, best = max(self.curve, key=lambda point: point[1], default=(self.done, math.nan))
        return FineTuning(
            views=views,
            held_in_views=set_aside,
            steps=self.done,
            steps_asked=self._steps,
            best_step=best_step,
            psnr_held_in=gain(self.curve[0][1], best) if self.curve else None,
            curve=[(step, round(psnr, 4)) for step, psnr in self.curve],
            seconds=round(seconds, 2),
            cpu_seconds=round(cpu_seconds, 2),
        )


def look(
    pictures: Iterable[tuple[Tensor, Tensor, Tensor | None]], count: int, progress: Progress = no_progress
) -> float:
    """Mean dB over the views of which any pixel counts.

    Args:
        pictures: of every view what is drawn and what its photograph shows [H, W, 3], and the mask of the pixels that
            count. They are made one by one.
        count: of them.
        progress: called after each.
    """
    values = []
    for rgb, target, mask in pictures:
        values.append(psnr(rgb.clamp(0.0, 1.0), target, mask))
        progress("looking at the set-aside views", len(values), count)
    return mean_psnr(values)


def gain(before: float, after: float) -> Gain:
    """Of two PSNRs, dB."""
    return Gain(before=round(before, 4), after=round(after, 4))


def set_aside(count: int, every: int) -> tuple[list[int], list[int]]:
    """Numbers of the views that are looked at, every so-many-th one or with 0 none, and of those that are learned
    from."""
    if every == 0:
        return [], list(range(count))
    return list(range(0, count, every)), [i for i in range(count) if i % every]
