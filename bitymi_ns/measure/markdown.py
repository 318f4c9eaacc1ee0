"""Markdown tables and sections, and rendering of the Jinja templates in templates/."""

import base64
import datetime
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from bitymi_ns.files import write_errors_as, write_file
from bitymi_ns.trust import printable
from .machine import commit, machine, versions


def escaped(text: str) -> str:
    """Escape the text of a table cell: one line, with literal bars and backslashes."""
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


def table(header: Sequence[str], rows: Sequence[Sequence[str]], text_columns: Sequence[int] = (0,)) -> str:
    """Format a table of cells, which may contain markup. `text_columns`: indices of the left-aligned columns."""
    rule = "".join("---|" if i in text_columns else "---:|" for i in range(len(header)))
    lines = ["| " + " | ".join(row) + " |" for row in (header, *rows)]
    return "\n".join([lines[0], "|" + rule, *lines[1:]])


def number(value: float | None, digits: int = 2) -> str:
    """Format a number; empty for None."""
    return "" if value is None else f"{value:,.{digits}f}"


def page(title: str, body: str, notes: Sequence[str] = (), commits: Sequence[str] = ()) -> str:
    """Format a section with its provenance. `commits`: those of the figures; empty: this checkout's."""
    measured = sorted(set(commits)) or [commit()]
    script = sys.argv[0].endswith(".py")
    program = ["python", os.path.relpath(sys.argv[0])] if script else [os.path.basename(sys.argv[0])]
    software = ", ".join(f"{name} {version}" for name, version in versions().items())
    lines = [f"## {title}", "", f"`{shlex.join([*program, *sys.argv[1:]])}`  ", f"{machine()}; {software}  "]
    lines += [f"{datetime.date.today():%Y-%m-%d}, commit {', '.join(c or 'unknown' for c in measured)}", "", body]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def publish(text: str, output: Path | None) -> None:
    """Print a page, and write it to a file. Raises ValueError: it cannot be written."""
    print(printable(text))
    if output is not None:
        with write_errors_as(output, ValueError):
            write_file(output, text.encode("utf8"), follow=True)


TEMPLATES = Environment(
    loader=PackageLoader("bitymi_ns.measure", "templates"),
    autoescape=select_autoescape(("html.j2",)),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
TEMPLATES.filters["data_uri"] = lambda data, mime: f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def rendered(template: str, **values: Any) -> str:
    """Render a template. Values are escaped in .html.j2."""
    return TEMPLATES.get_template(template).render(**values)
