"""Shared by the scripts of this folder: arguments, Markdown pages and progress as `bitymi bench` writes them."""

import argparse
from pathlib import Path

from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.markdown import number, page, table

__all__ = ["arguments_of", "number", "page", "publish", "say", "table"]


def arguments_of(script: str | None) -> argparse.ArgumentParser:
    """Make the parser of a script's arguments, with its docstring for a help text."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=script, formatter_class=formatter, allow_abbrev=False)


def publish(text: str, output: Path | None) -> None:
    """Print a page, and write it to `output` if that is a path."""
    print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")
