"""Parse command lines, write Markdown pages and time calls for the scripts of this folder."""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.markdown import number, page, table

__all__ = ["number", "say", "table"]  # re-exported: tables as those of `bitymi bench`
CLOCK = 2.0e9  # upper bound of GPU clocks, Hz, to convert seconds to cycles of `torch.cuda._sleep`


class Arguments(argparse.ArgumentParser):
    """Command line of a script, with its docstring as help text."""

    def __init__(self, script: str | None, name: str | None = None) -> None:
        formatter = argparse.RawDescriptionHelpFormatter
        super().__init__(name, description=script, formatter_class=formatter, allow_abbrev=False)

    def add_output(self) -> None:
        """Add the option of `publish`."""
        self.add_argument("--output", type=Path, help="also write the Markdown to this file")

    def device(self) -> torch.device:
        """Return the first GPU; end the script without one."""
        if not torch.cuda.is_available():
            self.error("no CUDA device was found (or torch is a CPU build)")
        return torch.device("cuda")


def image_size(text: str) -> tuple[int, int]:
    """Parse WxH."""
    width, height = (int(part) for part in text.split("x"))
    return width, height


def publish(title: str, body: str, notes: Sequence[str], output: Path | None) -> None:
    """Print a page of results, and write it to a file."""
    text = page(title, body, notes)
    print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")


@dataclass
class Rows:
    """Rows of a table, with those that failed listed below it."""

    header: Sequence[str]
    cells: list[Sequence[str]] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def add(self, what: str, measure: Callable[[], Sequence[str]]) -> None:
        """Measure a row; if that raises, list the error instead."""
        try:
            self.cells.append(measure())
        except (RuntimeError, ValueError, TypeError, AttributeError, OSError) as error:
            self.failed.append(f"{what}: {type(error).__name__}: {' '.join(str(error).split())[:400]}")
            say(self.failed[-1])

    def __str__(self) -> str:
        return table(self.header, self.cells) + "".join(f"\n\n- Failed: {text}" for text in self.failed)


@dataclass(frozen=True)
class Options:
    """Settings of a timing."""

    device: torch.device  # of the kernels; CPU: their emulation, to try a script without a GPU
    warm_up: int  # untimed calls
    runs: int  # timed calls


def seconds(run: Callable[[], object], options: Options) -> tuple[float, float]:
    """Measure the median wall-clock and CPU seconds of a call, including the wait for the device."""
    times = []
    for _ in range(options.warm_up + options.runs):
        wall, cpu = time.perf_counter(), time.process_time()
        run()
        if options.device.type == "cuda":
            torch.cuda.synchronize()
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = map(statistics.median, zip(*times[options.warm_up :], strict=True))
    return wall, cpu


def device_milliseconds(run: Callable[[], object], options: Options) -> float:
    """Measure the median device time of a call. Calls are queued behind a spin of the device that outlasts the
    queueing, so that launches are not measured. Synchronisations within a call are included."""
    if options.device.type != "cuda":
        return 1e3 * seconds(run, options)[0]
    for _ in range(options.warm_up):
        run()
    torch.cuda.synchronize()
    start = time.perf_counter()
    run()
    host = time.perf_counter() - start
    torch.cuda.synchronize()
    calls = max(1, min(16, options.runs, round(2e-3 / max(host, 1e-6))))
    samples = max(5, math.ceil(options.runs / calls))
    spin = int(min(0.02, 2.0 * calls * host + 1e-4) * CLOCK)
    times = []
    for _ in range(samples):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda._sleep(spin)
        begin.record()
        for _ in range(calls):
            run()
        end.record()
        torch.cuda.synchronize()
        times.append(begin.elapsed_time(end) / calls)
    return statistics.median(times)


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Average figures by name."""
    return {name: statistics.fmean(row[name] for row in rows) for name in rows[0]}
