"""Figures of panels, as PNG: the one style of all plots of this package."""

import io
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

PLAIN = ("default", {"text.parse_math": False})
"""Overrides a matplotlibrc in the current folder, which may enable LaTeX. Names may contain a $."""
INK, GRID = "#26292e", "#e3e5e8"
COLORS = (
    "#0b62b8", "#d1540b", "#1a8a5a", "#a8358f", "#8a6d00", "#128a9e", "#c22f3d", "#5b4bc4", "#6b6f76", "#4f7a14",
)  # fmt: skip
NUMBERS = FuncFormatter(lambda value, _: f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}")


class Panel(NamedTuple):
    """A function that draws a panel, its title and axes."""

    draw: Callable[[Axes], None]
    title: str
    x: str
    y: str


@style.context(PLAIN)
def png(panels: Sequence[Panel], legend: Sequence[Line2D] = (), most: int = 3) -> bytes:
    """Draw panels, at most `most` per row, with one legend below."""
    columns = min(most, len(panels))
    rows = math.ceil(len(panels) / columns)
    width, height = (6.4, 3.9) if columns == 1 else (3.5 * columns, 2.9)
    figure = Figure(figsize=(width, rows * height), dpi=160 if columns < 4 else 100, layout="constrained")
    FigureCanvasAgg(figure)
    for i, panel in enumerate(panels):
        axes = figure.add_subplot(rows, columns, i + 1)
        panel.draw(axes)
        axes.xaxis.set_major_formatter(NUMBERS)
        axes.yaxis.set_major_formatter(NUMBERS)
        axes.grid(True, color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8, length=3, which="both")
        axes.spines[["top", "right"]].set_visible(False)
        if len(panels) > 1:
            axes.set_title(panel.title, fontsize=9)
        axes.set_xlabel(panel.x, fontsize=9)
        axes.set_ylabel(panel.y, fontsize=9)
    if len(legend) > 1:
        longest = max(len(str(handle.get_label())) for handle in legend)
        ncols = max(1, min(len(legend), int(width * 16) // (longest + 7)))
        figure.legend(handles=legend, loc="outside lower center", frameon=False, fontsize=8, ncols=ncols)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": "bitymi report"})
    return buffer.getvalue()


def log_when_wide(axes: Axes, values: Sequence[float]) -> None:
    """Make the x axis logarithmic if its values span a factor of more than 8."""
    if min(values) > 0 and max(values) / min(values) > 8:
        axes.set_xscale("log")
        narrow = math.log10(max(values) / min(values)) < 2
        axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5) if narrow else (1,), numticks=12))
        axes.xaxis.set_minor_formatter(NullFormatter())
