"""Progress on a terminal, and an estimate of the time left."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bitymi_ns.measure.bench.cells import Cells
from bitymi_ns.measure.bench.engine import missing
from bitymi_ns.measure.bench.matrix import Stage
from bitymi_ns.trust import printable


class Estimate:
    """Seconds that a cell will take, from the cells that are finished.

    The mean over cells of the same kind and form; of these, those of the same scene and length of run where there are
    any, else of the same length, else all. Trainings of other lengths count by their seconds per step.
    """

    def __init__(self, cells: Cells) -> None:
        self._known: list[tuple[str, str | None, str, int | None, float]] = []
        for cell in cells:
            key, seconds = cell["key"], cell.get("made", {}).get("seconds")
            if isinstance(seconds, (int, float)):
                place = (key.get("cell"), key.get("bundle"), key.get("scene"), key.get("steps"))
                self._known.append((*place, float(seconds)))

    def add(self, stage: Stage, seconds: float) -> None:
        """Learn from a cell that has just been finished."""
        run, bundle = stage.run, stage.bundle
        self._known.append((stage.kind, bundle.name if bundle else None, run.scene.name, run.steps, seconds))

    def seconds(self, stage: Stage) -> float | None:
        """None when nothing like it is finished yet."""
        run, name = stage.run, stage.bundle.name if stage.bundle else None
        alike = [k for k in self._known if k[0] == stage.kind and k[1] == name]
        steps = run.steps
        for chosen in (
            [k for k in alike if k[2] == run.scene.name and k[3] == steps],
            [k for k in alike if k[3] == steps],
        ):
            if chosen:
                return sum(k[4] for k in chosen) / len(chosen)
        if stage.kind == "train" and steps:
            rates = [k[4] / k[3] for k in alike if k[3]]
            return steps * sum(rates) / len(rates) if rates else None
        return sum(k[4] for k in alike) / len(alike) if alike else None

    def total(self, stages: Iterable[Stage]) -> tuple[float, int]:
        """Seconds of all of them, and the number of those that nothing is known about."""
        guesses = [self.seconds(stage) for stage in stages]
        return sum(g for g in guesses if g is not None), sum(g is None for g in guesses)


def duration(seconds: float) -> str:
    """A rough duration for people."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


class Display:
    """A bar over all cells with what is being done and the time left; plain lines where there is no terminal."""

    def __init__(
        self, chains: Sequence[Sequence[Stage]], cells: Cells, workers: int = 1, console: Console | None = None
    ) -> None:
        """
        Args:
            chains: the cells of every run.
            cells: the finished ones.
            workers: cells that are done at the same time.
            console: where to write; None = stderr.
        """
        self.console = console or Console(stderr=True)
        self.workers = max(1, workers)
        self.pending = [stage for chain in chains for stage in missing(chain, cells)]
        self._estimate = Estimate(cells)
        self._running: dict[Stage, float] = {}
        columns = ("[progress.description]{task.description}", "{task.fields[left]}")
        self._progress = Progress(
            TextColumn(columns[0]), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn(columns[1]),
            console=self.console, disable=not self.console.is_terminal,
        )  # fmt: skip
        total = sum(map(len, chains))
        done = total - len(self.pending)
        self._task = self._progress.add_task("", total=total, completed=done, left=self.left())
        if done:
            self.console.print(f"{done} of {total} cells are finished already", highlight=False)

    def __enter__(self) -> Display:
        self._progress.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._progress.stop()

    def left(self) -> str:
        """The estimate of the time left."""
        if not self.pending:
            return ""
        seconds, unknown = self._estimate.total(self.pending)
        now = time.monotonic()
        for stage, start in self._running.items():
            seconds -= min(now - start, self._estimate.seconds(stage) or 0.0)
        if unknown == len(self.pending):
            return "time left unknown"
        more = f" and {unknown} cells of unknown length" if unknown else ""
        return f"about {duration(max(0.0, seconds) / self.workers)} left{more}"

    def started(self, stage: Stage) -> None:
        self._running[stage] = time.monotonic()
        self._show(str(stage))

    def finished(self, stage: Stage, seconds: float) -> None:
        self._estimate.add(stage, seconds)
        self._end(stage)
        self._show(None, f"{stage}: {duration(seconds)}")

    def failed(self, stage: Stage, reason: str) -> None:
        self._end(stage)
        self._show(None, f"{stage}: {'failed' if reason else 'left out'}")

    def _end(self, stage: Stage) -> None:
        self._running.pop(stage, None)
        self.pending = [other for other in self.pending if other != stage]
        self._progress.advance(self._task)

    def _show(self, description: str | None, line: str | None = None) -> None:
        left = self.left()
        text = printable(description if description is not None else ", ".join(map(str, self._running)))
        self._progress.update(self._task, description=text, left=left)
        if line is not None:
            self.console.print(
                printable(f"{line}{'; ' + left if left else ''}"), highlight=False, markup=False, soft_wrap=True
            )
        elif not self.console.is_terminal:
            self.console.print(printable(f"{description} ... "), highlight=False, markup=False, soft_wrap=True)
