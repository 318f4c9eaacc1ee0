"""Put a report together and write it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bitymi_ns import __version__
from bitymi_ns.files import check_writable, explained, flush, staging
from bitymi_ns.measure.report.collect import collect
from bitymi_ns.measure.report.gallery import make_gallery, make_worst
from bitymi_ns.measure.report.knob_plots import knob_tables
from bitymi_ns.measure.report.page import GENERATOR, Content, to_page, to_report_md
from bitymi_ns.measure.report.paper import paper_tables, wanted
from bitymi_ns.measure.report.plots import draw_plots, is_plot_name
from bitymi_ns.measure.report.poses import shown as shown_poses
from bitymi_ns.measure.report.records import Records, ReportError, over_seeds
from bitymi_ns.measure.report.tables import everything_table, quality_tables, summary, training_table
from bitymi_ns.measure.report.views import compare_views

PAGE = "report.md"
MARK = b"bitymi report"
"""In every file of a report."""


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def compose(records: Records, title: str, published: bool = False) -> Content:
    """Everything that a report says about these records.

    Args:
        records: what was read.
        title: heading of the page.
        published: show the paper's tables even when the input has no scene of its data sets.
    """
    views, others, view_notes = compare_views(records.images)
    gallery, notes = make_gallery(others)
    worst, more_notes = make_worst(records.worst)
    poses, poses_notes = shown_poses(records.poses)
    counts = [
        _counted(number, noun)
        for number, noun in (
            (len(records.evaluations), "evaluation"),
            (len(records.curves), "training run"),
            (len({row.scene for row in records.evaluations}), "scene"),
            (len(records.knobs), "knob setting"),
            (len(poses), "capture whose poses were found"),
        )
        if number
    ]
    merged = over_seeds(records.evaluations)
    shown = replace(records, evaluations=merged)
    measured = f" Measured on: {'; '.join(records.machines)}." if records.machines else ""
    return Content(
        title=title,
        intro=f"{', '.join(counts)}. Made by bitymi report {__version__}.{measured}",
        summary=summary(shown),
        quality=quality_tables(shown),
        training=training_table(records.curves),
        poses=poses,
        everything=everything_table(records.evaluations),
        plots=draw_plots(records),
        knobs=knob_tables(records.knobs),
        paper=paper_tables(records, merged) if published or wanted(records) else [],
        views=views,
        worst=worst,
        gallery=gallery,
        notes=[*records.notes, *view_notes, *notes, *more_notes, *poses_notes],
    )


def _check_output(output_dir: Path) -> None:
    """Refuse a destination that is a file, or in which somebody else made files of a report's names."""
    if output_dir.exists() and not output_dir.is_dir():
        raise ReportError(f"{output_dir} is a file; give a folder for the report.")
    page = output_dir / "index.html"
    if page.exists() and GENERATOR not in page.read_bytes()[:4096].decode("utf8", "replace"):
        raise ReportError(f"{page} was not made by bitymi report and will not be replaced; give another folder.")
    if page.exists() or not output_dir.is_dir():
        return
    names = [path for path in output_dir.iterdir() if path.name == PAGE or _is_plot(path)]
    strange = [path.name for path in names if path.is_dir() or MARK not in path.read_bytes()]
    if strange:
        raise ReportError(
            f"{output_dir} holds {', '.join(sorted(strange))}, which would be replaced and bitymi report has not "
            "made; give another folder."
        )


def _is_plot(path: Path) -> bool:
    return path.suffix == ".png" and is_plot_name(path.stem)


def write_aside(files: dict[str, bytes], output_dir: Path) -> None:
    """Write all files into a folder beside `output_dir` first, then rename them into place, index.html last.

    A write that fails leaves an older report as it was. Plots that an older report had and this one has not are
    removed; other files in the folder stay.
    """
    with staging(output_dir) as aside:
        for name, data in files.items():
            (aside / name).write_bytes(data)
            flush(aside / name)
        output_dir.mkdir(exist_ok=True)
        for name in sorted(files, key=lambda name: name == "index.html"):
            os.replace(aside / name, output_dir / name)
        for path in output_dir.iterdir():
            if _is_plot(path) and path.name not in files:
                path.unlink(missing_ok=True)


def build(inputs: Sequence[Path], output_dir: Path, title: str = "bitymi report", published: bool = False) -> Path:
    """Make a report: index.html (one self-contained page), report.md and the plots as PNG.

    Args:
        inputs: ns-eval JSON files, training curves (JSONL with `step` and any of `seconds`, `cpu_seconds`, `surfels`,
            `fragments`, `psnr`), cells, knobs and pictures of `bitymi bench`, report.json of
            camera poses, PNG images, and folders that are searched for all of these.
        output_dir: folder of the report; made if needed. A report of an earlier call is replaced.
        title: heading of the page.
        published: show the paper's tables even when the input has no scene of its data sets.

    Returns:
        The path of index.html.

    Raises:
        ReportError: an input is missing or broken, nothing usable was found, or the report cannot be written.
    """
    output_dir = Path(os.path.expanduser(output_dir)).absolute()
    _check_output(output_dir)
    with explained(output_dir, ReportError):
        check_writable(output_dir)
    content = compose(collect(list(inputs), output_dir), title, published)
    files = {f"{plot.name}.png": plot.light for plot in content.plots}
    files[PAGE] = to_report_md(content).encode("utf8")
    files["index.html"] = to_page(content).encode("utf8")
    with explained(output_dir, ReportError):
        write_aside(files, output_dir)
    return output_dir / "index.html"
