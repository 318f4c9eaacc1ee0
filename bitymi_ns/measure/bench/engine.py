"""Runs the cells of a matrix that are not finished yet."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from bitymi_ns.files import Busy, Lock, reason
from bitymi_ns.measure.bench.cells import FILE, Cells, made
from bitymi_ns.measure.bench.commands import prepare, read_result, stage_command
from bitymi_ns.measure.bench.matrix import Stage
from bitymi_ns.measure.bench.process import BenchError, CommandFailed, run_measured, say

Chain = Sequence[Stage]
"""The cells of one run; each may need those before it."""


class Watcher(Protocol):
    """What is told about progress."""

    def started(self, stage: Stage) -> None: ...

    def finished(self, stage: Stage, seconds: float) -> None: ...

    def failed(self, stage: Stage, reason: str) -> None: ...


class Silent:
    """Tells nobody."""

    def started(self, stage: Stage) -> None:
        pass

    def finished(self, stage: Stage, seconds: float) -> None:
        pass

    def failed(self, stage: Stage, reason: str) -> None:
        pass


def open_cells(work: Path) -> Cells:
    """The finished cells of a work folder."""
    return Cells(work / FILE)


def needs(stage: Stage, other: Stage) -> bool:
    """Whether `stage` cannot be done without `other`, of the same run."""
    if other.kind == "train":
        return stage.kind != "train"
    return other.kind == "export" and stage.kind == "eval" and stage.bundle == other.bundle


def missing(chain: Chain, cells: Cells) -> list[Stage]:
    """The cells of a run that are to be done: those without a line, and those that need one of these.

    A training that is done again makes the evaluations of the earlier one obsolete.
    """
    pending: list[Stage] = []
    for stage in chain:
        if cells.get(stage.key) is None or any(needs(stage, other) for other in pending):
            pending.append(stage)
    return pending


@contextmanager
def locked(work: Path, stage: Stage) -> Iterator[Lock]:
    """Hold a run, so that no other process works in its folders.

    Raises:
        CommandFailed: another process holds it.
    """
    path = work / "locks" / f"{stage.run.folder.replace('/', '--')}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = Lock(path, say)
    except Busy as error:
        raise CommandFailed(f"{stage.run}: {error}") from error
    except OSError as error:
        raise BenchError(f"{work} cannot be written: {reason(error, work)}, with --work") from error
    with lock:
        yield lock


def run_stage(work: Path, stage: Stage, cells: Cells, lock: Lock) -> float:
    """Do one cell and write its line; returns the seconds it took. The command holds the lock of the run, too.

    Raises:
        CommandFailed: its command failed, or left no figures.
    """
    command = stage_command(work, stage)
    start = time.perf_counter()
    cost = run_measured(command, prepare(work, stage), lock)
    value = read_result(work, stage, cost)
    seconds = time.perf_counter() - start
    cells.add(stage.key, value, made(command, seconds))
    return seconds


def run_chain(work: Path, chain: Chain, watcher: Watcher | None = None) -> list[str]:
    """Do the cells of a run that are not finished, in order. What needs a cell that failed is left out.

    Args:
        work: folder of runs and finished cells.
        chain: the cells.
        watcher: told about each.

    Returns:
        One message for every cell that failed.
    """
    watcher = watcher or Silent()
    cells = open_cells(work)
    pending = missing(chain, cells)
    if not pending:
        return []
    failures: list[str] = []
    broken: list[Stage] = []
    try:
        with locked(work, chain[0]) as lock:
            cells.refresh()
            for stage in missing(chain, cells):
                if any(needs(stage, other) for other in broken):
                    broken.append(stage)
                    watcher.failed(stage, "")
                    continue
                watcher.started(stage)
                try:
                    watcher.finished(stage, run_stage(work, stage, cells, lock))
                except CommandFailed as error:
                    broken.append(stage)
                    failures.append(f"{stage} failed: {error}")
                    watcher.failed(stage, str(error))
    except CommandFailed as error:
        failures.append(str(error))
        for stage in pending:
            watcher.failed(stage, "")
    return failures


def run_chains(work: Path, chains: Sequence[Chain], watcher: Watcher | None = None) -> list[str]:
    """Do run after run on this machine; returns one message for every cell that failed.

    Raises:
        BenchError: there is nothing to run.
    """
    if not any(chains):
        raise BenchError("nothing to run: there is no scene, or no method")
    return [failure for chain in chains for failure in run_chain(work, chain, watcher)]
