"""Tables of a report; their HTML is in templates/report.html.j2."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from .. import markdown
from ..markdown import escaped
from .records import Evaluation, grouped, means

MISSING = "–"
ARROWS = {"up": " ↑", "down": " ↓", None: ""}  # to the better direction, as in the paper


class Row(NamedTuple):
    cells: list[str]  # a section has one
    best: set[int]  # columns in which it has the table's best value


class Table(NamedTuple):
    title: str
    header: Sequence[str]
    rows: Sequence[Row]
    note: str = ""


class Column(NamedTuple):
    """A column of numbers."""

    title: str
    key: str  # of the results
    text: Callable[[float], str]
    better: Literal["up", "down"] | None = None

    def value(self, row: Evaluation) -> float | None:
        """Return the figure of an evaluation if it applies: of the training to trained scenes, of an atlas to
        bundles."""
        return None if self.key.startswith("train_" if row.baked else "atlas_") else row.results.get(self.key)


def significant(value: float) -> str:
    """Format about three significant digits."""
    magnitude = abs(value)
    if magnitude < 0.01:
        return f"{value:.2g}"
    decimals = 3 if magnitude < 1 else 2 if magnitude < 10 else 1 if magnitude < 100 else 0
    return f"{value:,.{decimals}f}"


def megabytes(value: float) -> str:
    return significant(value / 1e6)


COLUMNS = (
    Column("PSNR", "psnr", "{:.2f}".format, "up"),
    Column("± seeds", "psnr_seeds", "{:.2f}".format),
    Column("SSIM", "ssim", "{:.3f}".format, "up"),
    Column("LPIPS", "lpips", "{:.3f}".format, "down"),
    Column("LPIPS (VGG)", "lpips_vgg", "{:.3f}".format, "down"),
    Column("FLIP", "flip", "{:.3f}".format, "down"),
    Column("Atlas MB", "atlas_bytes", megabytes, "down"),
    Column("Bundle MB", "bundle_bytes", megabytes, "down"),
    Column("Points", "surfels", "{:,.0f}".format, "down"),
    Column("Fragments / px", "fragments_per_pixel", significant, "down"),
    Column("ms", "render_ms", significant, "down"),
    Column("ΔPSNR", "psnr_delta", lambda value: f"{value:+.3f}".replace("-", "−")),
)
FITTED = (
    Column("PSNR, mean exposure", "mean_exposure_psnr", "{:.2f}".format, "up"),
    Column("PSNR carried", "carried_psnr", "{:.2f}".format, "up"),
    Column("PSNR refined", "refined_psnr", "{:.2f}".format, "up"),
    Column("PSNR fitted", "fitted_psnr", "{:.2f}".format, "up"),
    Column("SSIM fitted", "fitted_ssim", "{:.3f}".format, "up"),
    Column("LPIPS fitted", "fitted_lpips", "{:.3f}".format, "down"),
)
TRAINING = (
    Column("Seconds", "train_seconds", significant, "down"),
    Column("CPU seconds", "train_cpu_seconds", significant, "down"),
    Column("Peak MB", "train_peak_bytes", lambda value: f"{value / 1e6:,.0f}", "down"),
)
KINDS = {"": COLUMNS, ", exposure aside": FITTED, ", training": TRAINING}
"""Columns of each kind of table by the end of its title; a table fits a window."""
STAGES = {False: "Trained scene", True: "Baked bundle"}

NOTES = (
    "ms: rendering alone, warmed up. 1 MB = 10⁶ bytes. ΔPSNR: baked minus trained, in dB. ± seeds: standard deviation "
    "of the PSNR over seeds. Fitted: each half of a view after the affine map of its colours that fits the other half "
    "to the photograph, so that exposure and white balance do not count. Carried, refined: held-out poses moved as the "
    "nearest photographs' were, or aligned to the scene. Mean exposure: drawn with the mean of the photographs' "
    "exposures, the others with that interpolated from the neighbouring photographs. Training: seconds of the steps "
    "alone, peak memory of ns-train as a whole. Bold: best of a table."
)


def scene_table(title: str, evaluations: list[Evaluation], columns: Sequence[Column], note: str = "") -> Table:
    """Build the table of one scene, with the best values of each column marked unless all are equal."""
    ordered = sorted(evaluations, key=lambda row: (row.baked, row.label))
    figures = {column: [column.value(row) for row in ordered] for column in columns}
    figures = {column: values for column, values in figures.items() if any(value is not None for value in values)}
    rows = [Row([row.label], set()) for row in ordered]
    for j, (column, values) in enumerate(figures.items(), 1):
        texts = [MISSING if value is None else column.text(value) for value in values]
        known = [value for value in values if value is not None]
        top = column.text(max(known) if column.better == "up" else min(known))
        marked = column.better and len({*texts} - {MISSING}) > 1
        for row, text in zip(rows, texts, strict=True):
            row.cells.append(text)
            if marked and text == top:  # compared as printed, so that equal figures are marked alike
                row.best.add(j)
    parts = grouped(zip(ordered, rows, strict=True), lambda pair: pair[0].baked)
    sections = [[Row([STAGES[baked]], set()), *(row for _, row in pairs)] for baked, pairs in parts.items()]
    return Table(
        title, ["Method", *(column.title + ARROWS[column.better] for column in figures)], sum(sections, []), note
    )


def quality_tables(evaluations: list[Evaluation]) -> list[Table]:
    """Build tables of each of the KINDS: one per scene, and one of the means of the labels evaluated on the largest set
    of scenes, as means over different scenes are not comparable."""
    tables = []
    for kind, columns in KINDS.items():
        rows = [row for row in evaluations if any(column.value(row) is not None for column in columns)]
        for scene, of_scene in sorted(grouped(rows, lambda row: row.scene).items()):
            tables.append(scene_table(scene + kind, of_scene, columns))
        labels = list(grouped(rows, lambda row: (row.baked, row.label)).values())
        widest = max(({row.scene for row in of_label} for of_label in labels), key=len, default=set())
        if len(widest) > 1:
            comparable = [of_label for of_label in labels if {row.scene for row in of_label} == widest]
            averaged = [replace(same[0], results=means([row.results for row in same])) for same in comparable]
            note = f"Scenes: {', '.join(sorted(widest))}."
            tables.append(scene_table(f"Mean of {len(widest)} scenes{kind}", averaged, columns, note))
    return tables


def to_markdown(table: Table) -> str:
    """Format a table without its title."""
    rows = []
    for row in table.rows:
        cells = [escaped(text) for text in row.cells]
        if len(cells) == 1:
            rows.append([f"*{cells[0]}*", *[""] * (len(table.header) - 1)])
        else:
            rows.append([f"**{cell}**" if i in row.best else cell for i, cell in enumerate(cells)])
    return markdown.table([escaped(text) for text in table.header], rows)


def quality_markdown(evaluations: list[Evaluation]) -> str:
    """Format the tables of evaluations as Markdown, with titles and notes."""
    parts = []
    for table in quality_tables(evaluations):
        parts += [f"### {table.title}", to_markdown(table), *filter(None, [table.note])]
    return "\n\n".join(parts)
