"""Tables of a report; their HTML is in templates/report.html.j2."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from bitymi_ns.measure import markdown
from bitymi_ns.measure.markdown import escaped
from bitymi_ns.measure.report.records import Curve, Evaluation, psnr_delta

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)

MISSING = "–"


@dataclass(frozen=True)
class Row:
    """A row of strings; `best` are the columns in which it has the table's best value. A section row has one cell."""

    cells: tuple[str, ...]
    best: frozenset[int] = frozenset()
    section: bool = False


@dataclass(frozen=True)
class Table:
    """A titled table of names (first column) and numbers."""

    title: str
    header: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Column:
    """A column of numbers: title, key of `shown_results`, format, and which direction is better."""

    title: str
    key: str
    text: Callable[[float], str]
    better: Literal["up", "down"] | None = None

    @property
    def heading(self) -> str:
        """Title with an arrow for the better direction, as in the paper."""
        return self.title + {"up": " ↑", "down": " ↓", None: ""}[self.better]


def significant(value: float) -> str:
    """Format about three significant digits, without an exponent for usual sizes."""
    magnitude = abs(value)
    if magnitude < 0.01:
        return f"{value:.2g}"
    decimals = 3 if magnitude < 1 else 2 if magnitude < 10 else 1 if magnitude < 100 else 0
    return f"{value:,.{decimals}f}"


def signed(value: float) -> str:
    """Format a difference with its sign and three decimals."""
    return f"{value:+.3f}".replace("-", "−")


def count(value: float) -> str:
    return f"{value:,.0f}"


def megabytes(value: float) -> str:
    """Format bytes as MB of 10^6."""
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
    Column("Points", "surfels", count, "down"),
    Column("Fragments / px", "fragments_per_pixel", significant, "down"),
    Column("ms", "render_ms", significant, "down"),
    Column("FPS", "frames_per_second", significant, "up"),
)
FITTED = (
    Column("PSNR, mean exposure", "mean_exposure_psnr", "{:.2f}".format, "up"),
    Column("PSNR carried", "carried_psnr", "{:.2f}".format, "up"),
    Column("PSNR refined", "refined_psnr", "{:.2f}".format, "up"),
    Column("PSNR fitted", "fitted_psnr", "{:.2f}".format, "up"),
    Column("SSIM fitted", "fitted_ssim", "{:.3f}".format, "up"),
    Column("LPIPS fitted", "fitted_lpips", "{:.3f}".format, "down"),
)
"""Columns of tables of their own, so that the others fit a window."""
TRAINING = (
    Column("Training s", "train_seconds", count),
    Column("Training CPU s", "train_cpu_seconds", count),
    Column("Training peak MB", "train_peak_bytes", lambda value: count(value / 1e6)),
)
"""Columns of training costs: times of the training steps only; peak memory of the whole ns-train process."""

CURVE_COLUMNS = (
    Column("Steps", "step", count),
    Column("Seconds", "seconds", significant),
    Column("CPU seconds", "cpu_seconds", significant),
    Column("Last PSNR", "psnr", "{:.2f}".format),
    Column("Last PSNR, mean exposure", "mean_exposure_psnr", "{:.2f}".format),
    Column("Last PSNR fitted", "fitted_psnr", "{:.2f}".format),
    Column("Points", "surfels", count),
    Column("Fragments", "fragments", count),
)
STAGES = {False: "Trained scene", True: "Baked bundle"}

NOTES = (
    "ms: rendering alone, warmed up; FPS = 1000 / ms (the fps of ns-eval also times metrics and files, so it is not "
    "shown). 1 MB = 10⁶ bytes. ΔPSNR: baked minus trained, in dB. ± seeds: standard deviation of the PSNR over seeds. "
    "Fitted: each half of a view after the affine map of its colours that fits the other half to the photograph, so "
    "that exposure and white balance do not count. Carried, refined: held-out poses moved as the nearest photographs' "
    "were, or aligned to the scene. Mean exposure: drawn with the mean of the photographs' exposures, the others with "
    "the exposure interpolated from the neighbouring photographs. Bold: best of its scene."
)


def shown_results(row: Evaluation, evaluations: list[Evaluation]) -> dict[str, float]:
    """Add derived values to the results of an evaluation, and drop those that do not apply to it."""
    results = {k: v for k, v in row.results.items() if not (row.baked and k.startswith("train_"))}
    if not results.get("atlas_bytes"):  # a trained scene has no atlas, not one of 0 MB
        results.pop("atlas_bytes", None)
    if milliseconds := results.get("render_ms"):
        results["frames_per_second"] = 1000.0 / milliseconds
    delta = psnr_delta(row, evaluations)
    return results if delta is None else {**results, "psnr_delta": delta}


def _rows(evaluations: list[Evaluation], columns: list[Column]) -> list[Row]:
    """Build one row per evaluation, with the best value of each column marked unless all are equal."""
    texts = []
    best: list[set[int]] = [set() for _ in evaluations]
    for j, column in enumerate(columns, 1):
        values = [row.results.get(column.key) for row in evaluations]
        written = [MISSING if v is None else column.text(v) for v in values]
        texts.append(written)
        known = [v for v in values if v is not None]
        if column.better and len({t for t in written if t != MISSING}) > 1:
            top = column.text(max(known) if column.better == "up" else min(known))
            for i, text in enumerate(written):
                if text == top:  # compared as printed, so that equal figures are marked alike
                    best[i].add(j)
    return [Row((row.label, *(column[i] for column in texts)), frozenset(best[i])) for i, row in enumerate(evaluations)]


def _grouped(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    groups: dict[K, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def _by_stage(title: str, columns: list[Column], rows: list[tuple[bool, Row]], note: str = "") -> Table:
    """Build a table with a section for trained scenes and one for bundles."""
    sections = []
    for baked in (False, True):
        of_stage = [row for stage, row in rows if stage is baked]
        sections += [Row((STAGES[baked],), section=True), *of_stage] if of_stage else []
    return Table(title, ("Method", *(c.heading for c in columns)), tuple(sections), note)


def scene_table(scene: str, evaluations: list[Evaluation], columns: list[Column]) -> Table:
    """Build the table of one scene: trained scenes, then bundles."""
    ordered = sorted(evaluations, key=lambda e: e.label)
    return _by_stage(scene, columns, [(e.baked, row) for e, row in zip(ordered, _rows(ordered, columns), strict=True)])


def mean_table(evaluations: list[Evaluation], columns: list[Column]) -> Table | None:
    """Average over scenes; None for a single scene.

    Only labels evaluated on the largest set of scenes are included: means over different scenes are not comparable.
    """
    groups = _grouped(evaluations, lambda e: (e.baked, e.label))
    covers = {key: frozenset(e.scene for e in rows) for key, rows in groups.items()}
    widest = max(covers.values(), key=len, default=frozenset())
    if len(widest) < 2:
        return None

    def mean(rows: list[Evaluation], column: Column) -> str:
        values = [row.results[column.key] for row in rows if column.key in row.results]
        return column.text(sum(values) / len(values)) if len(values) == len(rows) else MISSING

    kept = sorted(key for key, scenes in covers.items() if scenes == widest)
    rows = [(key[0], Row((key[1], *(mean(groups[key], column) for column in columns)))) for key in kept]
    return _by_stage(f"Mean of {len(widest)} scenes", columns, rows, "Scenes: " + ", ".join(sorted(widest)) + ".")


def training_table(curves: list[Curve]) -> Table | None:
    """Build the table of training runs: duration and final values."""
    if not curves:
        return None
    columns = [c for c in CURVE_COLUMNS if any(curve.last(c.key) is not None for curve in curves)]
    several = len({curve.scene for curve in curves}) > 1
    rows = []
    for curve in sorted(curves, key=lambda c: (c.scene, c.label)):
        values = [curve.last(c.key) for c in columns]
        name = f"{curve.scene}: {curve.label}" if several and curve.scene else curve.label
        cells = (MISSING if v is None else c.text(v) for c, v in zip(columns, values, strict=True))
        rows.append(Row((name, *cells)))
    return Table("Training", ("Run", *(c.title for c in columns)), tuple(rows))


def quality_tables(evaluations: list[Evaluation], training: bool = False) -> list[Table]:
    """Build one table per scene and one of means over scenes, and the same of FITTED; with the costs of training if
    `training`."""
    evaluations = [replace(row, results=shown_results(row, evaluations)) for row in evaluations]
    main = (*COLUMNS, *(TRAINING if training else ()), Column("ΔPSNR", "psnr_delta", signed))
    tables = []
    for wanted, what in ((main, ""), (FITTED, ", exposure aside")):
        rows = [row for row in evaluations if any(c.key in row.results for c in wanted)]
        columns = [c for c in wanted if any(c.key in row.results for row in rows)]
        for scene in sorted({row.scene for row in rows}):
            tables.append(scene_table(scene + what, [row for row in rows if row.scene == scene], columns))
        mean = mean_table(rows, columns)
        tables += [replace(mean, title=mean.title + what)] if mean else []
    return tables


def to_markdown(table: Table) -> str:
    """Format a table as Markdown, without its title."""
    width, rows = len(table.header), []
    for row in table.rows:
        cells = [escaped(text) for text in row.cells] + [""] * (width - len(row.cells))
        if row.section:
            cells[0] = f"*{cells[0]}*"
        rows.append([f"**{c}**" if i in row.best else c for i, c in enumerate(cells)])
    return markdown.table([escaped(text) for text in table.header], rows)


def markdown_tables(tables: Sequence[Table]) -> list[str]:
    """Format tables as Markdown paragraphs, each with its title and note."""
    parts = []
    for table in tables:
        parts += [f"### {table.title}", to_markdown(table), *filter(None, [table.note])]
    return parts
