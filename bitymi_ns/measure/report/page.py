"""A report as one self-contained HTML page."""

import importlib.metadata
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bitymi_ns.files import check_writable, write_errors_as, write_file
from bitymi_ns.safe_reading import open_regular
from ..markdown import rendered
from .pictures import ERROR_SCALE, compare_views
from .plots import draw_plots
from .read import collect
from .records import Records, ReportError, grouped, over_seeds
from .tables import NOTES, quality_tables

PAGE = "index.html"
GENERATOR = '<meta name="generator" content="bitymi report">'  # marks pages that may be replaced


def compose(records: Records, title: str) -> dict[str, Any]:
    """Build the variables of the page's template."""
    notes = list(records.notes)
    scenes = {row.scene for row in records.evaluations}
    counts = {"evaluation": records.evaluations, "training run": records.curves, "scene": scenes}
    counted = ", ".join(f"{len(c)} {noun}{'' if len(c) == 1 else 's'}" for noun, c in counts.items() if c)
    measured = f" Measured on: {'; '.join(dict.fromkeys(records.machines))}." if records.machines else ""
    return {
        "title": title,
        "intro": f"{counted}. Made by bitymi report {importlib.metadata.version('bitymi-ns')}.{measured}",
        "views": compare_views(records.images, notes),
        "quality": quality_tables(over_seeds(records.evaluations)),
        "sections": grouped(draw_plots(records.evaluations, records.curves), lambda plot: plot.section),
        "notes": notes,
    }


def to_page(content: dict[str, Any]) -> str:
    return rendered("report.html.j2", content=content, generator=GENERATOR, columns=NOTES, error_scale=ERROR_SCALE)


def build(inputs: Sequence[Path], output_dir: Path, title: str = "bitymi report") -> Path:
    """Write a report as index.html, which replaces an earlier one, and return its path. Raises ReportError: an input is
    missing or broken, nothing usable was found, or the report cannot be written.

    `inputs`: ns-eval JSON files, training curves (JSONL with `step` and any of `seconds`, `cpu_seconds`, `surfels`,
    `fragments`, `psnr`), cells of `bitymi bench`, PNG images of ns-eval, and folders to search for these."""
    output_dir = Path(os.path.expanduser(output_dir)).absolute()
    page = output_dir / PAGE
    with write_errors_as(output_dir, ReportError):
        check_writable(page)
        if page.exists():
            with open_regular(page) as file:
                if GENERATOR.encode() not in file.read(4096):
                    raise ReportError(f"{page} is no report and will not be replaced; give another folder.")
    text = to_page(compose(collect(list(inputs), output_dir), title))
    with write_errors_as(output_dir, ReportError):
        write_file(page, text.encode("utf8"))
    return page
