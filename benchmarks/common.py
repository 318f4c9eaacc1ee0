"""Helpers of the scripts in this folder: arguments, Markdown pages and progress as in `bitymi bench`."""

import argparse
from pathlib import Path

from bitymi_ns.measure.bench.process import say
from bitymi_ns.measure.markdown import number, page, table

__all__ = ["arguments_of", "number", "page", "publish", "say", "table"]


def arguments_of(script: str | None) -> argparse.ArgumentParser:
    """Create an argument parser with the script's docstring as help text."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=script, formatter_class=formatter, allow_abbrev=False)


def publish(text: str, output: Path | None) -> None:
    print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")
