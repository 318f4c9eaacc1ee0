"""Early stopping: the state of an optimisation that shows its validation views best."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar

from torch import Tensor

from bitymi_ns.bundle.statistics import FineTuning, Gain
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.losses import mean_psnr, psnr
from bitymi_ns.train.views import OnDemand, View

S = TypeVar("S")

FEWEST_VIEWS = 4  # with fewer nothing is optimised, except by `tune_atlas` without validation


class EarlyStopping(Generic[S]):
    """Best state by the PSNR of validation views: `best` is the state with the highest PSNR, the first included, or
    without validation views the last; `curve` has (step, dB) of every evaluation, `done` the steps before the last."""

    def __init__(self, steps: int, checks: int, patience: int, psnr: float, first: S) -> None:
        """`steps`: maximum number. `checks`: evaluations over the run. `patience`: evaluations without a gain before
        the end. `psnr`: dB before the first step; NaN without views. `first`: state then."""
        self._steps, self._patience = steps, patience
        self._every = max(1, -(-steps // checks))
        self.best = first
        self.curve = [] if math.isnan(psnr) else [(0, psnr)]
        self.done = 0

    def due(self, done: int) -> bool:
        return done % self._every == 0 or done == self._steps

    def update(self, done: int, psnr: float, state: Callable[[], S]) -> bool:
        """Record an evaluation after a step; return False where the last `patience` ones were all worse than the best.
        `psnr`: dB; NaN without views. `state`: makes a copy of the state."""
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

    def statistics(self, views: int, validation_views: int, seconds: float, cpu_seconds: float) -> FineTuning:
        best_step, best = max(self.curve, key=lambda point: point[1], default=(self.done, math.nan))
        return FineTuning(
            views=views,
            held_in_views=validation_views,
            steps=self.done,
            steps_asked=self._steps,
            best_step=best_step,
            psnr_held_in=gain(self.curve[0][1], best) if self.curve else None,
            curve=[(step, round(psnr, 4)) for step, psnr in self.curve],
            seconds=round(seconds, 2),
            cpu_seconds=round(cpu_seconds, 2),
        )


def evaluate(
    pictures: Iterable[tuple[Tensor, Tensor, Tensor | None]], count: int, progress: Progress = no_progress
) -> float:
    """Average the PSNR, dB, over `count` views with an unmasked pixel. `pictures`: rendering, photograph [H, W, 3] and
    mask."""
    values = []
    for rgb, target, mask in pictures:
        values.append(psnr(rgb.clamp(0.0, 1.0), target, mask))
        progress("evaluating the validation views", len(values), count)
    return mean_psnr(values)


def gain(before: float, after: float) -> Gain:
    return Gain(before=round(before, 4), after=round(after, 4))


def validation_split(views: Sequence[View], every: int) -> tuple[Sequence[View], Sequence[View]]:
    """Split into validation views, every `every`-th (0: none), and training views, read on access."""
    rows = range(len(views))
    parts = [i for i in rows if every and i % every == 0], [i for i in rows if not every or i % every]
    validation, trained = (OnDemand(len(part), lambda i, part=part: views[part[i]]) for part in parts)
    return validation, trained
