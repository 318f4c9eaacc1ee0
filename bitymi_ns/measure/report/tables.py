"""The tables of a report, as data and as Markdown; their HTML is in templates/report.html.j2."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from bitymi_ns.measure import markdown
from bitymi_ns.measure.markdown import escaped
from bitymi_ns.measure.report.records import Curve, Evaluation, Records, psnr_delta, trained_parent

MISSING = "–"


@dataclass(frozen=True)
class Row:
    """A row of texts; `best` holds the columns whose value is the best of its table. A section row has one cell."""

    cells: tuple[str, ...]
    best: frozenset[int] = frozenset()
    section: bool = False


@dataclass(frozen=True)
class Table:
    """A titled table; the first column is a name, the others are numbers."""

    title: str
    header: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Column:
    """A column of numbers: its title, how a value is read and written, and which direction is better."""

    title: str
    value: Callable[[Evaluation], float | None]
    text: Callable[[float], str]
    better: Literal["up", "down"] | None = None

    @property
    def heading(self) -> str:
        """The title with the paper's arrow."""
        return self.title + {"up": " ↑", "down": " ↓", None: ""}[self.better]


def significant(value: float) -> str:
    """About three significant digits, without an exponent for the sizes that occur here."""
    magnitude = abs(value)
    if magnitude < 0.01:
        return f"{value:.2g}"
    decimals = 3 if magnitude < 1 else 2 if magnitude < 10 else 1 if magnitude < 100 else 0
    return f"{value:,.{decimals}f}"


def exact(value: float) -> str:
    """Six significant digits; whole numbers in full."""
    return f"{value:,.0f}" if abs(value) >= 1e5 or value == round(value) else f"{value:.6g}"


def signed(value: float) -> str:
    """A difference with its sign and three decimals."""
    return f"{value:+.3f}".replace("-", "−")


def count(value: float) -> str:
    """A whole number with separators."""
    return f"{value:,.0f}"


def _key(name: str, scale: float = 1.0) -> Callable[[Evaluation], float | None]:
    def value(row: Evaluation) -> float | None:
        number = row.get(name)
        return None if number is None else number * scale

    return value


def _fps(row: Evaluation) -> float | None:
    milliseconds = row.get("render_ms")
    return 1000.0 / milliseconds if milliseconds else None


def _atlas_mb(row: Evaluation) -> float | None:
    return row.results.get("atlas_bytes", 0.0) / 1e6 or None  # a trained row has no atlas, not one of 0 MB


COLUMNS = (
    Column("PSNR", _key("psnr"), "{:.2f}".format, "up"),
    Column("± seeds", _key("psnr_seeds"), "{:.2f}".format),
    Column("ccPSNR", _key("cc_psnr"), "{:.2f}".format, "up"),
    Column("SSIM", _key("ssim"), "{:.3f}".format, "up"),
    Column("LPIPS", _key("lpips"), "{:.3f}".format, "down"),
    Column("LPIPS (VGG)", _key("lpips_vgg"), "{:.3f}".format, "down"),
    Column("FLIP", _key("flip"), "{:.3f}".format, "down"),
    Column("Points", _key("surfels"), count, "down"),
    Column("Fragments / px", _key("fragments_per_pixel"), significant, "down"),
    Column("ms", _key("render_ms"), significant, "down"),
    Column("FPS", _fps, significant, "up"),
    Column("Atlas MB", _atlas_mb, significant, "down"),
    Column("Bundle MB", _key("bundle_bytes", 1e-6), significant, "down"),
)
"""The paper's columns and the run-time figures beside them."""

STAGES = {False: "Trained scene", True: "Baked bundle"}

NOTES = (
    "ms: rendering alone, warmed up; FPS = 1000 / ms (the fps of ns-eval also times metrics and files, so it is not "
    "shown). 1 MB = 10⁶ bytes. ΔPSNR: baked minus trained, in dB. ± seeds: standard "
    "deviation of the PSNR over seeds. ccPSNR: after an affine fit of each view's colours to its photograph, so that "
    "exposure and white balance do not count. Bold: best of its scene."
)


def _numbers(evaluations: list[Evaluation], everyone: list[Evaluation]) -> list[Column]:
    """The columns that at least one row fills."""
    delta = Column("ΔPSNR", lambda row: psnr_delta(row, everyone), signed)
    return [c for c in (*COLUMNS, delta) if any(c.value(row) is not None for row in evaluations)]


def _rows(evaluations: list[Evaluation], columns: list[Column]) -> list[Row]:
    """One row per evaluation, the best value of each column marked when the rows differ in it."""
    texts = []
    best: list[set[int]] = [set() for _ in evaluations]
    for j, column in enumerate(columns, 1):
        values = [column.value(row) for row in evaluations]
        written = [MISSING if v is None else column.text(v) for v in values]
        texts.append(written)
        known = [v for v in values if v is not None]
        if column.better and len({t for t in written if t != MISSING}) > 1:
            top = column.text(max(known) if column.better == "up" else min(known))
            for i, text in enumerate(written):
                if text == top:  # equal as printed: no row is bold for digits that nobody sees
                    best[i].add(j)
    return [Row((row.label, *(column[i] for column in texts)), frozenset(best[i])) for i, row in enumerate(evaluations)]


def scene_table(scene: str, evaluations: list[Evaluation], columns: list[Column]) -> Table:
    """The evaluations of one scene: those before baking, then those after."""
    ordered = sorted(evaluations, key=lambda e: (e.baked, e.label))
    rows: list[Row] = []
    for i, row in enumerate(_rows(ordered, columns)):
        if i == 0 or ordered[i].baked != ordered[i - 1].baked:
            rows.append(Row((STAGES[ordered[i].baked],), section=True))
        rows.append(row)
    return Table(scene, ("Method", *(c.heading for c in columns)), tuple(rows))


def mean_table(evaluations: list[Evaluation], columns: list[Column]) -> Table | None:
    """Means over scenes, for what was evaluated in the largest number of scenes; None for a single scene.

    Only labels that cover the same scenes are put side by side: a mean over other scenes is not comparable.
    """
    groups: dict[tuple[bool, str], list[Evaluation]] = {}
    for row in evaluations:
        groups.setdefault((row.baked, row.label), []).append(row)
    covers = {key: frozenset(e.scene for e in rows) for key, rows in groups.items()}
    widest = max(covers.values(), key=len, default=frozenset())
    if len(widest) < 2:
        return None
    kept = sorted(key for key, scenes in covers.items() if scenes == widest)

    def mean(rows: list[Evaluation], column: Column) -> str:
        values = [v for v in map(column.value, rows) if v is not None]
        return column.text(sum(values) / len(values)) if len(values) == len(rows) else MISSING

    rows: list[Row] = []
    for i, key in enumerate(kept):
        if i == 0 or key[0] != kept[i - 1][0]:
            rows.append(Row((STAGES[key[0]],), section=True))
        rows.append(Row((key[1], *(mean(groups[key], column) for column in columns))))
    header = ("Method", *(c.heading for c in columns))
    return Table(f"Mean of {len(widest)} scenes", header, tuple(rows), "Scenes: " + ", ".join(sorted(widest)) + ".")


def training_table(curves: list[Curve]) -> Table | None:
    """One row per training run: how long, and where it ended."""
    if not curves:
        return None
    columns: list[tuple[str, Callable[[Curve], float | None], Callable[[float], str]]] = [
        ("Steps", lambda c: c.last("step"), count),
        ("Seconds", lambda c: c.last("seconds"), significant),
        ("CPU seconds", lambda c: c.last("cpu_seconds"), significant),
        ("Last PSNR", lambda c: c.last("psnr"), "{:.2f}".format),
        ("Best PSNR", lambda c: c.best("psnr"), "{:.2f}".format),
        ("Last ccPSNR", lambda c: c.last("cc_psnr"), "{:.2f}".format),
        ("Points", lambda c: c.last("surfels"), count),
        ("Fragments", lambda c: c.last("fragments"), count),
    ]
    columns = [c for c in columns if any(c[1](curve) is not None for curve in curves)]
    several = len({curve.scene for curve in curves}) > 1
    rows = []
    for curve in sorted(curves, key=lambda c: (c.scene, c.label)):
        values = [(value(curve), text) for _, value, text in columns]
        name = f"{curve.scene}: {curve.label}" if several and curve.scene else curve.label
        rows.append(Row((name, *(MISSING if v is None else text(v) for v, text in values))))
    return Table("Training", ("Run", *(c[0] for c in columns)), tuple(rows))


def everything_table(evaluations: list[Evaluation]) -> Table | None:
    """Every number that was recorded, with its spread over the views and its file."""
    if not evaluations:
        return None
    recorded = {key for row in evaluations for key in row.results}
    keys = sorted(key for key in recorded if key.removesuffix("_std") not in recorded - {key})

    def text(row: Evaluation, key: str) -> str:
        value, spread = row.get(key), row.get(f"{key}_std")
        if value is None:
            return MISSING
        return f"{exact(value)} ± {spread:.3g}" if spread and spread < 1000 else exact(value)

    rows = tuple(
        Row(
            (
                f"{row.scene}: {row.label}{', baked' if row.baked else ''}",
                *(text(row, key) for key in keys),
                str(row.source),
            )
        )
        for row in sorted(evaluations, key=lambda e: (e.scene, e.baked, e.label))
    )
    return Table("All recorded numbers (mean ± standard deviation over the views)", ("Evaluation", *keys, "File"), rows)


def quality_tables(records: Records) -> list[Table]:
    """One table per scene in the paper's layout, and the means when there are several scenes."""
    evaluations = records.evaluations
    columns = _numbers(evaluations, evaluations)
    scenes = sorted({row.scene for row in evaluations})
    tables = [scene_table(scene, [e for e in evaluations if e.scene == scene], columns) for scene in scenes]
    mean = mean_table(evaluations, columns)
    return [*tables, mean] if mean else tables


def summary(records: Records, limit: int = 8) -> list[str]:
    """A sentence for each baked evaluation with a trained parent; none when there are more than `limit`."""
    lines = []
    for row in sorted(records.evaluations, key=lambda e: (e.scene, e.label)):
        delta = psnr_delta(row, records.evaluations)
        parent = trained_parent(row, records.evaluations)
        if parent is None or delta is None:
            continue
        parts = [f"{parent.results['psnr']:.2f} dB trained, {row.results['psnr']:.2f} dB baked ({signed(delta)})"]
        before, after = parent.get("render_ms"), row.get("render_ms")
        if before and after:
            parts.append(
                f"{significant(before)} ms to {significant(after)} ms per view ({before / after:.1f}× as fast)"
            )
        megabytes = _atlas_mb(row)
        if megabytes:
            parts.append(f"atlas of {significant(megabytes)} MB")
        lines.append(f"{row.scene}, {row.label}: " + "; ".join(parts) + ".")
    return lines if len(lines) <= limit else []


def to_markdown(table: Table) -> str:
    """A table as Markdown, without its title."""
    width, rows = len(table.header), []
    for row in table.rows:
        cells = [escaped(text) for text in row.cells] + [""] * (width - len(row.cells))
        if row.section:
            cells[0] = f"*{cells[0]}*"
        rows.append([f"**{c}**" if i in row.best else c for i, c in enumerate(cells)])
    return markdown.table([escaped(text) for text in table.header], rows)
