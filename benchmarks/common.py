"""What the scripts of this folder share with `bitymi bench`: pages of Markdown."""

from __future__ import annotations

from pathlib import Path

from bitymi_ns.bench.commands import read_curve
from bitymi_ns.bench.process import CommandFailed, say
from bitymi_ns.bench.tables import number, page, table

__all__ = ["CommandFailed", "number", "page", "publish", "read_curve", "say", "table"]


def publish(text: str, output: Path | None) -> None:
    """Print a page, and write it where asked."""
    print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")
