"""What the scripts of this folder share with `bitymi bench`: pages of Markdown."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

if importlib.util.find_spec("bitymi_ns") is None:  # not installed, or not yet: gpu.py builds it
    sys.path.append(str(Path(__file__).resolve().parent.parent))

from bitymi_ns.measure.bench.commands import read_curve
from bitymi_ns.measure.bench.process import CommandFailed, say
from bitymi_ns.measure.bench.tables import difference, number, page
from bitymi_ns.measure.markdown import table

__all__ = ["CommandFailed", "difference", "number", "page", "publish", "read_curve", "say", "table"]


def publish(text: str, output: Path | None, silent: bool = False) -> None:
    """Print a page (unless `silent`), and write it where asked."""
    if not silent:
        print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")
