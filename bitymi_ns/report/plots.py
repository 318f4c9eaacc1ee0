"""The plots of a report as PNG bytes: one panel a scene, one colour a method, in light and dark."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from bitymi_ns.report.records import Curve, Evaluation, Records, neural_parent


@dataclass(frozen=True)
class Theme:
    """Colours of a plot."""

    paper: str
    ink: str
    grid: str
    lines: tuple[str, ...]


LIGHT = Theme(
    "#ffffff", "#26292e", "#e3e5e8",
    ("#0b62b8", "#d1540b", "#1a8a5a", "#a8358f", "#8a6d00", "#128a9e", "#c22f3d", "#5b4bc4", "#6b6f76", "#4f7a14"),
)  # fmt: skip
DARK = Theme(
    "#1b1e23", "#dfe2e6", "#363b43",
    ("#6db3f2", "#f59a5b", "#5fcf9d", "#e58ad0", "#dcc04e", "#5ecfe0", "#f48089", "#a99cf5", "#b4b8bf", "#a2cf5f"),
)  # fmt: skip


MARKERS = ("s", "^", "D", "v", "P", "X", "*", "p")
"""Marks of baked evaluations, one a format."""


@dataclass(frozen=True)
class Plot:
    """A drawn plot: file name without ending, title, and the PNG in both themes."""

    name: str
    title: str
    light: bytes
    dark: bytes


@dataclass(frozen=True)
class Sheet:
    """What one plot shows: `draw(axes, scene, theme)` fills the panel of a scene."""

    name: str
    title: str
    x: str
    y: str
    scenes: tuple[str, ...]
    draw: Callable[[Axes, str, Theme], None]
    legend: tuple[tuple[str, dict], ...]
    """Entries: text and Line2D properties; an int as `color` is a number of the theme's line colours."""


def _line_color(theme: Theme, index: int) -> str:
    return theme.lines[index % len(theme.lines)]


def _plain(value: float, _position: int | None = None) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}"


def _log_when_wide(axes: Axes, values: list[float]) -> None:
    """A logarithmic x axis for positive values that span more than a factor of eight."""
    if values and min(values) > 0 and max(values) / min(values) > 8:
        axes.set_xscale("log")
        narrow = math.log10(max(values) / min(values)) < 2
        axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5) if narrow else (1,), numticks=12))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.margins(x=0.12)


def _style(axes: Axes, theme: Theme) -> None:
    axes.set_facecolor(theme.paper)
    axes.grid(True, color=theme.grid, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=theme.ink, labelsize=8, length=3, which="both")
    axes.xaxis.set_major_formatter(FuncFormatter(_plain))
    axes.yaxis.set_major_formatter(FuncFormatter(_plain))
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.ink)


def _png(sheet: Sheet, theme: Theme) -> bytes:
    """Draw a sheet: at most three panels a row, one legend below."""
    columns = min(3, len(sheet.scenes))
    rows = math.ceil(len(sheet.scenes) / columns)
    width = 6.4 if columns == 1 else 3.5 * columns
    panel = 3.9 if columns == 1 else 2.9
    figure = Figure(figsize=(width, rows * panel), dpi=160, facecolor=theme.paper, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False)
    for i, axes in enumerate(grid.flat):
        if i >= len(sheet.scenes):
            axes.remove()
            continue
        sheet.draw(axes, sheet.scenes[i], theme)
        _style(axes, theme)
        if len(sheet.scenes) > 1:
            axes.set_title(sheet.scenes[i] or "no scene named", fontsize=9, color=theme.ink)
        if i + columns >= len(sheet.scenes):
            axes.set_xlabel(sheet.x, fontsize=9, color=theme.ink)
        if i % columns == 0:
            axes.set_ylabel(sheet.y, fontsize=9, color=theme.ink)
    handles = []
    for text, properties in sheet.legend:
        color = properties.get("color", theme.ink)
        color = _line_color(theme, color) if isinstance(color, int) else color
        hollow = {"markerfacecolor": theme.paper} if properties.get("hollow") else {}
        rest = {key: value for key, value in properties.items() if key not in ("color", "hollow")}
        handles.append(Line2D([], [], color=color, label=text, **rest, **hollow))
    if len(handles) > 1:
        longest = max(len(handle.get_label()) for handle in handles)
        figure.legend(
            handles=handles, loc="outside lower center", frameon=False, fontsize=8, labelcolor=theme.ink,
            ncols=max(1, min(len(handles), int(width * 16) // (longest + 7))),
        )  # fmt: skip
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=theme.paper, metadata={"Software": None})
    return buffer.getvalue()


def _curve_sheet(name: str, title: str, x: str, y: str, keys: tuple[str, str], curves: list[Curve],
                 colors: dict[str, int]) -> Sheet | None:  # fmt: skip
    """`keys[1]` against `keys[0]` of every curve that records both at least once."""
    drawn = [c for c in curves if c.series(*keys)[0]]
    if not drawn:
        return None

    def draw(axes: Axes, scene: str, theme: Theme) -> None:
        for curve in drawn:
            if curve.scene == scene:
                xs, ys = curve.series(*keys)
                marker = "o" if len(xs) <= 20 else ""
                axes.plot(xs, ys, color=_line_color(theme, colors[curve.label]), linewidth=1.6, marker=marker, ms=3)
        if keys[1] == "surfels":
            axes.set_ylim(bottom=0)

    labels = sorted({c.label for c in drawn})
    legend = tuple((label, {"color": colors[label], "linewidth": 2}) for label in labels)
    return Sheet(name, title, x, y, tuple(sorted({c.scene for c in drawn})), draw, legend)


def _scatter_sheet(name: str, title: str, x: str, value: Callable[[Evaluation], float | None],
                   evaluations: list[Evaluation], colors: dict[str, int], arrows: bool) -> Sheet | None:  # fmt: skip
    """PSNR against `value`: hollow circles before baking, filled marks after, a thin line from parent to bundle."""
    points = {id(e): (value(e), e.get("psnr")) for e in evaluations}
    drawn = [e for e in evaluations if None not in points[id(e)]]
    if not drawn:
        return None
    variants = sorted({_variant(e) for e in drawn if e.baked})
    markers = {variant: MARKERS[i % len(MARKERS)] for i, variant in enumerate(variants)}

    def draw(axes: Axes, scene: str, theme: Theme) -> None:
        here = [e for e in drawn if e.scene == scene]
        for e in here:
            color = _line_color(theme, colors[e.method])
            px, py = points[id(e)]
            if e.baked:
                parent = neural_parent(e, drawn) if arrows else None
                if parent is not None:
                    qx, qy = points[id(parent)]
                    axes.plot([qx, px], [qy, py], color=color, linewidth=0.9, alpha=0.55, zorder=2)
                axes.plot([px], [py], color=color, marker=markers[_variant(e)], ms=6, linestyle="", zorder=3)
            else:
                axes.plot([px], [py], color=color, marker="o", ms=7, linestyle="", zorder=3,
                          markerfacecolor=theme.paper, markeredgewidth=1.8)  # fmt: skip
        axes.margins(0.12)
        _at_least(axes, [points[id(e)][1] for e in here], 0.5)
        _log_when_wide(axes, [points[id(e)][0] for e in here])

    legend: list[tuple[str, dict]] = [
        (method, {"color": colors[method], "linewidth": 4}) for method in sorted({e.method for e in drawn})
    ]
    if any(not e.baked for e in drawn):
        legend.append(("pre-bake", {"marker": "o", "ms": 7, "linestyle": "", "hollow": True, "markeredgewidth": 1.8}))
    legend += [
        (f"post-bake, {variant}" if variant else "post-bake", {"marker": marker, "ms": 6, "linestyle": ""})
        for variant, marker in markers.items()
    ]
    return Sheet(name, title, x, "PSNR (dB)", tuple(sorted({e.scene for e in drawn})), draw, tuple(legend))


def _at_least(axes: Axes, values: list[float], span: float) -> None:
    """A y axis of at least `span`, so that differences in the third decimal do not look like cliffs."""
    low, high = min(values), max(values)
    if high - low < span:
        middle = (low + high) / 2
        axes.set_ylim(middle - 0.6 * span, middle + 0.6 * span)


def _variant(row: Evaluation) -> str:
    """What a label says beyond the method: the atlas format, or what tells it from its namesakes."""
    return row.label.removeprefix(row.method).strip(", ()")


def _positive(key: str, scale: float = 1.0) -> Callable[[Evaluation], float | None]:
    return lambda e: (e.get(key) or 0.0) * scale or None


def draw_plots(records: Records) -> list[Plot]:
    """Every plot for which there are data."""
    rows, curves = records.evaluations, records.curves
    names = dict.fromkeys([*sorted({e.method for e in rows}), *sorted({c.label for c in curves})])
    colors = {name: i for i, name in enumerate(names)}
    psnr = "PSNR (dB)"
    sheets = [
        _curve_sheet("psnr_seconds", "PSNR against training seconds", "training seconds", psnr,
                     ("seconds", "psnr"), curves, colors),
        _curve_sheet("psnr_cpu_seconds", "PSNR against CPU seconds of training", "CPU seconds", psnr,
                     ("cpu_seconds", "psnr"), curves, colors),
        _scatter_sheet("psnr_render_ms", "PSNR against render milliseconds", "milliseconds a view", _positive(
                       "render_ms"), rows, colors, arrows=True),
        _scatter_sheet("psnr_bytes", "PSNR against atlas size", "atlas MB", _positive("atlas_bytes", 1e-6),
                       rows, colors, arrows=False),
        _curve_sheet("surfels_steps", "Surfels over training steps", "step", "surfels",
                     ("step", "surfels"), curves, colors),
    ]  # fmt: skip
    return [Plot(s.name, s.title, _png(s, LIGHT), _png(s, DARK)) for s in sheets if s is not None]


PLOT_NAMES = ("psnr_seconds", "psnr_cpu_seconds", "psnr_render_ms", "psnr_bytes", "surfels_steps")
"""Every name that `draw_plots` can give."""
