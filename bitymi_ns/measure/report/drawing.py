"""How a plot is drawn: one panel per scene, in light and dark, as PNG bytes."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

PLAIN = ("default", {"text.parse_math": False})
"""How plots are drawn, whatever a matplotlibrc in the current folder says: it may ask for LaTeX. Names may hold a $."""


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


@dataclass(frozen=True)
class Plot:
    """A drawn plot: file name without ending, title, section of the page, number of panels, PNG in both themes."""

    name: str
    title: str
    section: str
    panels: int
    light: bytes
    dark: bytes


@dataclass(frozen=True)
class Sheet:
    """What one plot shows: `draw(axes, scene, theme)` fills the panel of a scene."""

    name: str
    title: str
    section: str
    x: str
    y: str
    scenes: tuple[str, ...]
    draw: Callable[[Axes, str, Theme], None]
    points: int
    """Points of the fullest panel or, of curves, of the longest line."""
    legend: tuple[tuple[str, dict], ...]
    """Entries: text and Line2D properties; an int as `color` is a number of the theme's line colours."""


def line_color(theme: Theme, index: int) -> str:
    return theme.lines[index % len(theme.lines)]


def _plain(value: float, _position: int | None = None) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}"


def log_when_wide(axes: Axes, values: list[float]) -> None:
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


@style.context(PLAIN)
def _png(sheet: Sheet, theme: Theme) -> bytes:
    """Draw a sheet: at most three panels per row, one legend below."""
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
        color = line_color(theme, color) if isinstance(color, int) else color
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
    figure.savefig(buffer, format="png", facecolor=theme.paper, metadata={"Software": "bitymi report"})
    return buffer.getvalue()


def draw(sheet: Sheet) -> Plot:
    """The plot of a sheet."""
    return Plot(sheet.name, sheet.title, sheet.section, len(sheet.scenes), _png(sheet, LIGHT), _png(sheet, DARK))
