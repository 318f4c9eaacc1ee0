"""What the scripts of this folder share with `bitymi bench`: pages of Markdown."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

if importlib.util.find_spec("bitymi_ns") is None:  # not installed, or not yet: gpu.py builds it
    sys.path.append(str(Path(__file__).resolve().parent.parent))

from bitymi_ns.measure.bench.engine import read_curve
from bitymi_ns.measure.bench.process import CommandFailed, say
from bitymi_ns.measure.markdown import difference, number, page, table

T = TypeVar("T")
__all__ = ["CommandFailed", "cpu_milliseconds", "difference", "number", "page", "publish", "read_curve", "say", "table"]


def cpu_milliseconds(run: Callable[[], T], repeats: int) -> tuple[T, float]:
    """What a call returns, and the least milliseconds of the thread over some calls; one before them makes room."""
    times, result = [], run()
    for _ in range(repeats):
        start = time.thread_time()
        result = run()
        times.append(1e3 * (time.thread_time() - start))
    return result, min(times)


def publish(text: str, output: Path | None, silent: bool = False) -> None:
    """Print a page (unless `silent`), and write it where asked."""
    if not silent:
        print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")
