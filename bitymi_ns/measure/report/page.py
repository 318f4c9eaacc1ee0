"""Composition of a report as one self-contained HTML page."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bitymi_ns import __version__
from bitymi_ns.capture.report import PICTURE
from bitymi_ns.files import check_writable, write_errors_as, write_file
from bitymi_ns.measure.markdown import rendered
from bitymi_ns.measure.report.pictures import ERROR_CAPTION, compare_views, encode_files, worst_views
from bitymi_ns.measure.report.plots import Plot, draw_plots
from bitymi_ns.measure.report.read import collect
from bitymi_ns.measure.report.records import Records, ReportError, over_seeds
from bitymi_ns.measure.report.tables import NOTES, poses_tables, quality_tables, training_table
from bitymi_ns.safe_reading import open_regular

PAGE = "index.html"
GENERATOR = '<meta name="generator" content="bitymi report">'  # marks pages that may be replaced
VIEWS_NOTE = f"The worst, the median and the best view by the PSNR of these pictures, with their {ERROR_CAPTION}."
TRADE_OFF = "The dashed line is the Pareto front: of all points of a scene those that no other beats in both."


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def compose(records: Records, title: str) -> dict[str, Any]:
    """Build the variables of the page's template from records."""
    notes = list(records.notes)
    found = {json.dumps(values, sort_keys=True): (path, values) for path, values in records.poses.items()}
    counts = {
        "evaluation": len(records.evaluations),
        "training run": len(records.curves),
        "scene": len({row.scene for row in records.evaluations}),
        "capture with found poses": len(found),  # runs with the same poses count once
    }
    counted = ", ".join(_counted(number, noun) for noun, number in counts.items() if number)
    measured = f" Measured on: {'; '.join(records.machines)}." if records.machines else ""
    sections: dict[str, list[Plot]] = {}
    for plot in draw_plots(records.evaluations, records.curves):
        sections.setdefault(plot.section, []).append(plot)
    poses = []
    for path, values in found.values():
        caption, picture = "Cameras (red) and points, from above and from the side.", path.with_name(PICTURE)
        pictures = encode_files([(caption, picture)] if picture.is_file() else [], notes)
        poses.append((poses_tables(values), pictures))
    return {
        "title": title,
        "intro": f"{counted}. Made by bitymi report {__version__}.{measured}",
        "views": compare_views(records.images, notes),
        "quality": quality_tables(over_seeds(records.evaluations)),
        "training": training_table(records.curves),
        "poses": poses,
        "sections": sections,
        "worst": worst_views(records.worst, notes),
        "notes": notes,
    }


def to_page(content: dict[str, Any]) -> str:
    """Render the report as a self-contained HTML document."""
    texts = {"views": VIEWS_NOTE, "tables": NOTES, "trade_off": TRADE_OFF}
    return rendered("report.html.j2", content=content, generator=GENERATOR, texts=texts)


def _check_output(output_dir: Path) -> None:
    """Refuse an output folder that holds a page other than a report."""
    page = output_dir / PAGE
    if page.exists() and GENERATOR not in _beginning(page):
        raise ReportError(f"{page} was not made by bitymi report and will not be replaced; give another folder.")


def _beginning(page: Path) -> str:
    with open_regular(page) as file:
        return file.read(4096).decode("utf8", "replace")


def build(inputs: Sequence[Path], output_dir: Path, title: str = "bitymi report") -> Path:
    """Write a report as a self-contained index.html and return its path.

    Args:
        inputs: ns-eval JSON files, training curves (JSONL with `step` and any of `seconds`, `cpu_seconds`, `surfels`,
            `fragments`, `psnr`), cells and images of `bitymi bench`, report.json of camera poses, PNG images of
            ns-eval, and folders to search for these.
        output_dir: folder of the report, created if needed; an earlier report is replaced.

    Raises:
        ReportError: an input is missing or broken, nothing usable was found, or the report cannot be written.
    """
    output_dir = Path(os.path.expanduser(output_dir)).absolute()
    with write_errors_as(output_dir, ReportError):
        check_writable(output_dir / PAGE)
        _check_output(output_dir)
    text = to_page(compose(collect(list(inputs), output_dir), title))
    with write_errors_as(output_dir, ReportError):
        write_file(output_dir / PAGE, text.encode("utf8"))
    return output_dir / PAGE
