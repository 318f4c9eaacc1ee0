"""Build the tables of a report; their HTML is in templates/report.html.j2."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from bitymi_ns.measure import markdown
from bitymi_ns.measure.markdown import escaped
from bitymi_ns.measure.report.records import Curve, Evaluation, FoundPoses, KnobPoint, psnr_delta, trained_parent

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


def _trained(name: str, scale: float = 1.0) -> Callable[[Evaluation], float | None]:
    return lambda row: None if row.baked else _key(name, scale)(row)


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
TRAINING = (
    Column("Training s", _trained("train_seconds"), count),
    Column("Training CPU s", _trained("train_cpu_seconds"), count),
    Column("Training peak MB", _trained("train_peak_bytes", 1e-6), count),
)
"""Of the training steps alone; the peak is that of ns-train as a whole."""

STAGES = {False: "Trained scene", True: "Baked bundle"}

NOTES = (
    "ms: rendering alone, warmed up; FPS = 1000 / ms (the fps of ns-eval also times metrics and files, so it is not "
    "shown). 1 MB = 10⁶ bytes. ΔPSNR: baked minus trained, in dB. ± seeds: standard deviation of the PSNR over seeds. "
    "ccPSNR: after an affine fit of each view's colours to its photograph, so that exposure and white balance do not "
    "count. Bold: best of its scene."
)


def _numbers(evaluations: list[Evaluation], training: bool) -> list[Column]:
    """The columns that at least one row fills."""
    delta = Column("ΔPSNR", lambda row: psnr_delta(row, evaluations), signed)
    wanted = (*COLUMNS, *(TRAINING if training else ()), delta)
    return [c for c in wanted if any(c.value(row) is not None for row in evaluations)]


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


def quality_tables(evaluations: list[Evaluation], training: bool = False) -> list[Table]:
    """One table per scene, and their means when there are several scenes; with the cost of training if `training`."""
    columns = _numbers(evaluations, training)
    scenes = sorted({row.scene for row in evaluations})
    tables = [scene_table(scene, [e for e in evaluations if e.scene == scene], columns) for scene in scenes]
    mean = mean_table(evaluations, columns)
    return [*tables, mean] if mean else tables


def summary(evaluations: list[Evaluation], limit: int = 8) -> list[str]:
    """A sentence for each baked evaluation with a trained parent; none when there are more than `limit`."""
    lines = []
    for row in sorted(evaluations, key=lambda e: (e.scene, e.label)):
        delta = psnr_delta(row, evaluations)
        parent = trained_parent(row, evaluations)
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


KNOBS = {
    "weight_bound": "Weight bound",
    "transmittance": "Termination threshold",
    "format": "Atlas format",
    "r_max": "Largest tile side",
    "tolerance": "Atlas tolerance",
    "resolution": "Resolution of rendering",
}
"""Knob -> title of its table."""


def knob_tables(points: list[KnobPoint]) -> list[Table]:
    """One table per knob; the error is against its exact setting."""
    tables = []
    header = ("Setting", "mean steps", "max steps", "dB to exact", "PSNR", "ms", "CPU ms", "MB")
    columns = (
        ("mean_steps", 1.0, "{:.3f}".format), ("max_steps", 1.0, "{:.2f}".format), ("psnr_exact", 1.0, _decibel),
        ("psnr", 1.0, "{:.2f}".format), ("ms", 1.0, significant), ("cpu_ms", 1.0, significant),
        ("bytes", 1e-6, significant),
    )  # fmt: skip
    for knob in dict.fromkeys(p.knob for p in points):
        groups: dict[str, list[KnobPoint]] = {}
        of_knob = [p for p in points if p.knob == knob]
        for p in of_knob:
            groups.setdefault(f"{p.scene}, {p.run}, {p.renderer} renderer", []).append(p)
        rows: list[Row] = []
        for title, group in groups.items():
            rows.append(Row((title,), section=True))
            for p in group:
                marks = [text for text, holds in (("exact", p.exact), ("default", p.default)) if holds]
                texts = (text(scale * p.figures[key]) if key in p.figures else MISSING for key, scale, text in columns)
                rows.append(Row((p.value + (f" ({', '.join(marks)})" if marks else ""), *texts)))
        note = f"{of_knob[0].against[:1].upper()}{of_knob[0].against[1:]}." if of_knob[0].against else ""
        tables.append(Table(KNOBS.get(knob, knob), header, tuple(rows), note))
    return tables


def _decibel(value: float) -> str:
    return "equal" if value >= 100 else f"{value:.1f}"


MOST_NAMED = 60
"""Photographs that a table names; report.json has them all."""


def poses_tables(found: FoundPoses) -> list[Table]:
    """Statistics of the camera poses of a capture, seconds of each stage, and photographs with a reason or remark."""

    def text(key: str, form: str) -> str:
        return form.format(found.numbers[key]) if key in found.numbers else MISSING

    overview = {
        "Photographs with a pose": f"{text('registered', '{:,.0f}')} of {text('given', '{:,.0f}')}",
        "Mean reprojection error, pixels": text("reprojection_error", "{:.2f}"),
        "Mean track length, photographs per point": text("track_length", "{:.2f}"),
        "Points": text("points", "{:,.0f}"),
        "Median parallax, degrees": text("parallax_degrees", "{:.1f}"),
        "Up, scale": found.frame,
    }
    seconds = {stage: f"{value:.1f}" for stage, value in found.seconds.items()}
    tables = [
        Table("Poses", ("", found.source), tuple(map(Row, overview.items()))),
        Table("Time of every stage", ("Stage", "Seconds"), tuple(map(Row, seconds.items()))),
        _named(found.left_out, "Left out", "Why"),
        _named(found.notes, "Notes", ""),
    ]
    return [table for table in tables if table.rows]


def _named(photographs: Mapping[str, str], title: str, header: str) -> Table:
    rows = tuple(map(Row, list(photographs.items())[:MOST_NAMED]))
    more = len(photographs) - len(rows)
    note = f"And {more:,} more, which report.json names." if more else ""
    return Table(f"{title}: {len(photographs):,}", ("Photograph", header), rows, note)


def to_markdown(table: Table) -> str:
    """A table as Markdown, without its title."""
    width, rows = len(table.header), []
    for row in table.rows:
        cells = [escaped(text) for text in row.cells] + [""] * (width - len(row.cells))
        if row.section:
            cells[0] = f"*{cells[0]}*"
        rows.append([f"**{c}**" if i in row.best else c for i, c in enumerate(cells)])
    return markdown.table([escaped(text) for text in table.header], rows)


def markdown_tables(tables: Sequence[Table]) -> list[str]:
    """Tables as Markdown paragraphs, each with its title and note."""
    parts = []
    for table in tables:
        parts += [f"### {table.title}", to_markdown(table), *filter(None, [table.note])]
    return parts
