"""Figures of panels, as PNG, in one style."""

import io
import math
from collections.abc import Sequence

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

INK = "#26292e"
COLORS = (
    "#0b62b8", "#d1540b", "#1a8a5a", "#a8358f", "#8a6d00", "#128a9e", "#c22f3d", "#5b4bc4", "#6b6f76", "#4f7a14",
)  # fmt: skip
SETTINGS = {
    "text.parse_math": False,  # names may contain a $
    "axes.grid": True, "grid.color": "#e3e5e8", "grid.linewidth": 0.8, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 9, "axes.labelsize": 9,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "xtick.major.size": 3, "ytick.major.size": 3, "xtick.minor.size": 3,
    "ytick.minor.size": 3, "legend.frameon": False, "legend.fontsize": 8, "figure.constrained_layout.use": True,
}  # fmt: skip
styled = style.context(("default", SETTINGS))
"""Decorator of functions that draw: overrides a matplotlibrc, which may enable LaTeX."""
NUMBERS = FuncFormatter(lambda value, _: f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}")


def panels(titles: Sequence[str], x: str, y: str, most: int = 3) -> tuple[Figure, list[Axes]]:
    """Create a figure with a panel per title, at most `most` per row. `x`, `y`: labels of the axes."""
    columns = min(most, len(titles))
    rows = math.ceil(len(titles) / columns)
    width, height = (6.4, 3.9) if columns == 1 else (3.5 * columns, 2.9)
    figure = Figure(figsize=(width, rows * height), dpi=160 if columns < 4 else 100)
    shown = titles if len(titles) > 1 else [""]
    return figure, [figure.add_subplot(rows, columns, i, title=t, xlabel=x, ylabel=y) for i, t in enumerate(shown, 1)]


def png(figure: Figure, legend: Sequence[Line2D] = ()) -> bytes:
    """Encode a figure with one legend below its panels."""
    for axes in figure.axes:
        axes.xaxis.set_major_formatter(NUMBERS)
        axes.yaxis.set_major_formatter(NUMBERS)
    if len(legend) > 1:
        longest = max(len(str(handle.get_label())) for handle in legend)
        ncols = max(1, min(len(legend), int(figure.get_figwidth() * 16) // (longest + 7)))
        figure.legend(handles=legend, loc="outside lower center", ncols=ncols)
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
