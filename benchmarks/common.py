"""Shared by the scripts of this folder: Markdown pages and progress, as `bitymi bench` writes them."""

from pathlib import Path

from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.markdown import number, page, table

__all__ = ["number", "page", "publish", "say", "table"]


def publish(text: str, output: Path | None, silent: bool = False) -> None:
    """Print a page (unless `silent`), and write it to `output` if that is a path."""
    if not silent:
        print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")
