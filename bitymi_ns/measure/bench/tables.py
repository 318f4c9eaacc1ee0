"""Finished cells as Markdown: what `bitymi bench` prints at its end."""

from __future__ import annotations

import datetime
import os
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from bitymi_ns.measure.bench.cells import Cells
from bitymi_ns.measure.bench.machine import commit, machine, software
from bitymi_ns.measure.bench.matrix import Matrix, Run, Stage
from bitymi_ns.measure.markdown import table

HEADER = (
    "scene", "row", "form", "PSNR", "ccPSNR", "SSIM", "FLIP", "LPIPS", "LPIPS (VGG)", "surfels", "fragments/px",
    "render ms", "training s", "training CPU s", "process CPU s", "peak RSS MB", "bundle bytes", "atlas bytes", "dPSNR",
)  # fmt: skip
TEXT_COLUMNS = 3
NOTES = (
    "Means over the held-out views; render ms: one view, rendering alone; dPSNR: a bundle's PSNR minus that of the "
    "trained scene it was baked from; ccPSNR: after an affine fit of each view's colours to its photograph. LPIPS: "
    "AlexNet fed with [-1, 1]; LPIPS (VGG): VGG16 fed with [0, 1], as the code of 3D Gaussian Splatting does.",
    "Training seconds: the training steps alone; process CPU seconds and peak RSS: ns-train from start to end, with "
    "loading, evaluation and saving.",
)


def number(value: float | None, digits: int = 2) -> str:
    """A number for a table, with separators of thousands; nothing for None."""
    return "" if value is None else f"{value:,.{digits}f}"


def difference(value: float, digits: int = 3) -> str:
    """A signed number for a table; no sign where it rounds to zero."""
    rounded = round(value, digits)
    return f"{rounded:+.{digits}f}" if rounded else f"{0.0:.{digits}f}"


def command_line() -> str:
    """How this program was called."""
    program = os.path.basename(sys.argv[0])
    start = ["python", os.path.relpath(sys.argv[0])] if program.endswith(".py") else [program]
    return shlex.join([*start, *sys.argv[1:]])


def page(title: str, body: str, notes: Sequence[str] = (), commits: Sequence[str] = ()) -> str:
    """A Markdown section: title, how it was made, table, notes.

    Args:
        commits: of the cells that the table shows; none = made now, by the checkout as it is.
    """
    made = sorted(set(commits)) or [commit()]
    lines = [f"## {title}", "", f"`{command_line()}`  ", f"{machine()}; {software()}  "]
    lines += [f"{datetime.date.today():%Y-%m-%d}, commit {', '.join(c or 'unknown' for c in made)}", "", body]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def _line(
    run: Run, form: str, results: dict[str, Any], cost: dict[str, Any], size: int | None, delta: str
) -> list[str]:
    peak = cost.get("peak_bytes")
    digits = {"psnr": 2, "cc_psnr": 2, "ssim": 4, "flip": 4, "lpips": 4, "lpips_vgg": 4}
    digits |= {"surfels": 0, "fragments_per_pixel": 2, "render_ms": 1}
    return [
        *_names(run),
        form,
        *(number(results.get(key), count) for key, count in digits.items()),
        number(cost.get("seconds"), 0),
        number(cost.get("cpu_seconds"), 0),
        number(cost.get("process_cpu_seconds"), 0),
        number(None if peak is None else peak / 1e6, 0),
        number(size, 0),
        number(results.get("atlas_bytes"), 0),
        delta,
    ]


def results_table(matrix: Matrix, cells: Cells) -> tuple[str, list[str]]:
    """One line per evaluated form of each run: the trained scene, then its bundles.

    Returns:
        The table without columns that no line fills, and the commits that made its cells.
    """
    lines, commits = [], []
    for run in matrix.runs():
        train = cells.get(Stage(run, "train").key)
        trained = cells.get(Stage(run, "eval").key)
        for bundle in (None, *matrix.bundles):
            cell = cells.get(Stage(run, "eval", bundle).key)
            if cell is None:
                continue
            results = cell["value"]["results"]
            exported = cells.get(Stage(run, "export", bundle).key) if bundle else None
            delta = difference(results["psnr"] - trained["value"]["results"]["psnr"]) if bundle and trained else ""
            cost = train["value"] if train and bundle is None else {}
            size = exported["value"]["bytes"] if exported else None
            lines.append(_line(run, bundle.name if bundle else "trained", results, cost, size, delta))
            commits += [c["made"]["commit"] for c in (train, cell, exported) if c]
    return _without_empty(HEADER, lines), commits


BUNDLE_HEADER = (
    "scene", "row", "bundle", "surfels", "sites per surfel", "one colour", "texels per surfel", "atlas bytes",
    "of the first", "dPSNR", "PSNR to trained", "dFLIP", "render ms", "tile error p99", "colour error p99",
)  # fmt: skip
BUNDLE_NOTES = (
    "dPSNR and dFLIP: against the photographs, bundle minus trained scene; PSNR to trained: bundle against trained "
    "scene on the held-out views, as the exporter measures it.",
    "Tile error: root mean square of a tile against the field as stored, in 8-bit steps, 99th percentile.",
    "Sites per surfel: what is left of the view colour (or coefficients, lobes); one colour: share of the surfels with "
    "nothing but a constant; colour error: largest over the directions of the training views and others between, times "
    "the blending weight, in 8-bit steps, 99th percentile. Bundles that keep all have none of these.",
)


def bundles_table(matrix: Matrix, cells: Cells) -> str:
    """What sets the bundles of each run apart: size and error beside the first of them, and what they leave out."""
    from bitymi_ns.bundle.statistics import Statistics  # with torch, which nothing else of the benchmark needs

    lines = []
    for run in matrix.runs():
        trained = cells.get(Stage(run, "eval").key)
        first: float | None = None
        for bundle in matrix.bundles:
            exported = cells.get(Stage(run, "export", bundle).key)
            cell = cells.get(Stage(run, "eval", bundle).key)
            if exported is None or cell is None or trained is None:
                continue
            results, before = cell["value"]["results"], trained["value"]["results"]
            statistics = Statistics.model_validate(exported["value"]["statistics"], strict=False)
            kept, texels = statistics.surfels.kept, statistics.texels
            texels = None if texels is None else texels.after_cap_by_views if texels.kept is None else texels.kept
            size, lean = results.get("atlas_bytes"), statistics.view_color
            held_out, error = statistics.held_out, statistics.error
            first = size if first is None else first
            flips = (results.get("flip"), before.get("flip"))
            lines.append(
                [
                    *_names(run),
                    bundle.name,
                    number(kept, 0),
                    number(lean.sites.after / kept if lean else None, 2),
                    number(lean.one_color / kept if lean else None, 3),
                    number(None if texels is None else texels / kept, 0),
                    number(size, 0),
                    number(size / first, 3) if size and first else "",
                    difference(results["psnr"] - before["psnr"]),
                    number(held_out.psnr_baked_against_neural if held_out else None),
                    "" if None in flips else difference(flips[0] - flips[1], 4),
                    number(results.get("render_ms"), 1),
                    number(error.rms.p99 if error else None),
                    number(lean.error.p99 if lean else None),
                ]
            )
    return _without_empty(BUNDLE_HEADER, lines)


def _names(run: Run) -> list[str]:
    name = run.row.name if run.seed is None else f"{run.row.name}, seed {run.seed}"
    return [run.scene.name, name.replace("|", "\\|")]


def _without_empty(header: Sequence[str], lines: list[list[str]]) -> str:
    """A table without the columns that no line fills."""
    kept = [j for j in range(len(header)) if j < TEXT_COLUMNS or any(line[j] for line in lines)]
    return table([header[j] for j in kept], [[line[j] for j in kept] for line in lines], range(TEXT_COLUMNS))


def results_page(title: str, matrix: Matrix, cells: Cells, failures: Sequence[str] = ()) -> str:
    """The tables of a matrix with their notes."""
    body, commits = results_table(matrix, cells)
    notes = list(NOTES)
    if len(matrix.bundles) > 1:
        body += "\n\n" + bundles_table(matrix, cells)
        notes += BUNDLE_NOTES
    failed = [f"Failed: {line.splitlines()[0].removesuffix(', whose end is:')}." for line in failures]
    return page(title, body, [*notes, *failed], commits)
