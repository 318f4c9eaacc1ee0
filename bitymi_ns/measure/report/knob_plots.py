"""Quality knobs: the error that each setting costs against the time or bytes that it saves, as plots and tables."""

from __future__ import annotations

from collections import Counter

from matplotlib.axes import Axes

from bitymi_ns.measure.report.drawing import Sheet, Theme, line_color, log_when_wide
from bitymi_ns.measure.report.records import KnobPoint
from bitymi_ns.measure.report.tables import MISSING, Row, Table, significant

KNOBS = "Quality knobs: what they cost and save"
"""Heading of the page's section on quality knobs."""
TITLES = {
    "weight_bound": "Weight bound",
    "transmittance": "Termination threshold",
    "format": "Atlas format",
    "r_max": "Largest tile side",
    "tolerance": "Atlas tolerance",
    "resolution": "Resolution of rendering",
}
_FLOOR = 1e-4
"""Errors below this many 8-bit steps are drawn here: nobody sees them, and 0 has no logarithm."""


def _panel_name(point: KnobPoint) -> str:
    return f"{point.scene}, {point.run}"


def _by_bytes(points: list[KnobPoint]) -> bool:
    return any(p.figures.get("bytes") for p in points if not p.exact)


def knob_sheets(points: list[KnobPoint]) -> list[Sheet]:
    """One sheet per knob: mean and largest error against CPU milliseconds per view, or megabytes where the knob changes
    them; one panel per run."""
    return [_sheet(knob, [p for p in points if p.knob == knob]) for knob in dict.fromkeys(p.knob for p in points)]


def _sheet(knob: str, points: list[KnobPoint]) -> Sheet:
    by_bytes = _by_bytes(points)
    key, scale, x = ("bytes", 1e-6, "atlas MB") if by_bytes else ("cpu_ms", 1.0, "CPU milliseconds per view")
    renderers = sorted({p.renderer for p in points if not p.exact})
    colors = {renderer: i for i, renderer in enumerate(renderers)}

    def panel(axes: Axes, scene: str, theme: Theme) -> None:
        values = []
        for renderer in renderers:
            here = [p for p in points if _panel_name(p) == scene and p.renderer == renderer and key in p.figures]
            color = line_color(theme, colors[renderer])
            for p in here:
                if p.exact and not by_bytes:
                    values.append(p.figures[key])
                    axes.axvline(p.figures[key], color=color, linewidth=0.9, linestyle=(0, (2, 3)))
                    axes.annotate("exact" + (", default" if p.default else ""), (p.figures[key], 0.02),
                                  (-3, 0), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=7,
                                  color=color, rotation=90, ha="right", va="bottom")  # fmt: skip
            here = [p for p in here if not p.exact]
            for error, style, marker in (("mean_steps", "-", "o"), ("max_steps", ":", "^")):
                drawn = [p for p in here if error in p.figures]
                xs = [scale * p.figures[key] for p in drawn]
                ys = [max(_FLOOR, p.figures[error]) for p in drawn]
                axes.plot(xs, ys, style, color=color, marker=marker, ms=4, linewidth=1.2)
                values += xs
                if error == "mean_steps":
                    for p, px, py in zip(drawn, xs, ys, strict=True):
                        if p.default:
                            axes.plot([px], [py], "o", ms=9, markerfacecolor="none", color=color)
                        axes.annotate(
                            p.value, (px, py), (4, 5), textcoords="offset points", fontsize=7, color=theme.ink
                        )
        axes.set_yscale("log")
        axes.axhline(1.0, color=theme.ink, linewidth=0.7, alpha=0.5)
        axes.margins(0.12)
        log_when_wide(axes, values)

    legend: list[tuple[str, dict]] = []
    for renderer in renderers:
        legend.append((f"mean error, {renderer}", {"color": colors[renderer], "marker": "o", "ms": 4}))
        legend.append((f"largest, {renderer}", {"color": colors[renderer], "marker": "^", "ms": 4, "linestyle": ":"}))
    legend.append(("default", {"marker": "o", "ms": 9, "linestyle": "", "hollow": True}))
    scenes = tuple(dict.fromkeys(map(_panel_name, points)))
    title = f"{TITLES.get(knob, knob)}: error in 8-bit steps against {'size' if by_bytes else 'time'}"
    most = max(Counter(map(_panel_name, points)).values())
    return Sheet(f"knob_{knob}", title, KNOBS, x, "error (8-bit steps)", scenes, panel, most, tuple(legend))


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
        rows: list[Row] = []
        of_knob = [p for p in points if p.knob == knob]
        for name in dict.fromkeys(map(_panel_name, of_knob)):
            here = [p for p in of_knob if _panel_name(p) == name]
            for renderer in dict.fromkeys(p.renderer for p in here if not p.exact):
                rows.append(Row((f"{name}, {renderer} renderer",), section=True))
                for p in (p for p in here if p.exact or p.renderer == renderer):
                    if p.exact and p.renderer != renderer and any(q.exact and q.renderer == renderer for q in here):
                        continue
                    marks = [text for text, given in (("exact", p.exact), ("default", p.default)) if given]
                    texts = (
                        text(scale * p.figures[key]) if key in p.figures else MISSING for key, scale, text in columns
                    )
                    marked = f" ({', '.join(marks)})" if marks else ""
                    rows.append(Row((p.value + marked, *texts)))
        note = f"{of_knob[0].against[:1].upper()}{of_knob[0].against[1:]}." if of_knob[0].against else ""
        tables.append(Table(TITLES.get(knob, knob), header, tuple(rows), note))
    return tables


def _decibel(value: float) -> str:
    return "equal" if value >= 100 else f"{value:.1f}"
