"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Sequence


def escaped(text: str) -> str:
    """The text of a cell, in one line, its bars and backslashes as they are read."""
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


def table(header: Sequence[str], rows: Sequence[Sequence[str]], text_columns: Sequence[int] = (0,)) -> str:
    """A table, without a line's end at its end.

    Args:
        header: of the columns.
        rows: their cells; markup in them is kept.
        text_columns: numbers of the columns that are flush left; the others hold numbers.
    """
    rule = "".join("---|" if i in text_columns else "---:|" for i in range(len(header)))
    lines = ["| " + " | ".join(row) + " |" for row in (header, *rows)]
    return "\n".join([lines[0], "|" + rule, *lines[1:]])
