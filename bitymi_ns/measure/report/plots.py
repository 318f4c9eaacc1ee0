"""Plots of a report: training curves, and quality against cost with Pareto fronts; one panel per scene."""

import io
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from bitymi_ns.measure.report.records import Curve, Evaluation

PLAIN = ("default", {"text.parse_math": False})
"""Style of all plots: overrides a matplotlibrc in the current folder, which may enable LaTeX. Names may contain a $."""
INK, GRID = "#26292e", "#e3e5e8"
COLORS = (
    "#0b62b8", "#d1540b", "#1a8a5a", "#a8358f", "#8a6d00", "#128a9e", "#c22f3d", "#5b4bc4", "#6b6f76", "#4f7a14",
)  # fmt: skip
MARKERS = ("s", "^", "D", "v", "P", "X", "*", "p", "<", ">", "h", "d", "8", "H")
"""Markers of bundles, one per format."""
TRAINING, RENDERING, SIZE = "Error against training time", "Error against rendering time", "Error against size"
CURVES = (
    ("PSNR in the course of training", "training seconds", "PSNR (dB)", ("seconds", "psnr")),
    ("PSNR by CPU seconds of training", "CPU seconds", "PSNR (dB)", ("cpu_seconds", "psnr")),
    ("Surfels over training steps", "step", "surfels", ("step", "surfels")),
)
"""Plots of training curves: title, axes, columns."""
METRICS = {
    "psnr": ("PSNR (dB)", True, 0.5),
    "ssim": ("SSIM", True, 0.01),
    "flip": ("FLIP", False, 0.01),
    "lpips": ("LPIPS", False, 0.01),
    "lpips_vgg": ("LPIPS (VGG)", False, 0.01),
}
"""Metric -> title, True if higher is better, minimum span of its axis."""
MIN_POINTS = 3  # minimum number of points of a plot; for fewer the tables suffice


@dataclass(frozen=True)
class Plot:
    """A plot: title, section of the page, number of panels, PNG bytes; `front`: has a Pareto front."""

    title: str
    section: str
    panels: int
    png: bytes
    front: bool


@dataclass(frozen=True)
class Cost:
    """A cost axis: name in titles, axis label, section of the page, value."""

    title: str
    label: str
    section: str
    value: Callable[[Evaluation], float | None]


def costs(rows: list[Evaluation]) -> tuple[Cost, ...]:
    """List the cost axes. Sizes are those of whole bundles (downloads) if all bundles state them, else of atlases."""

    def positive(key: str, scale: float = 1.0) -> Callable[[Evaluation], float | None]:
        return lambda e: (e.get(key) or 0.0) * scale or None

    baked = [e for e in rows if e.baked]
    whole = bool(baked) and all(e.get("bundle_bytes") for e in baked)
    key, what = ("bundle_bytes", "bundle") if whole else ("atlas_bytes", "atlas")
    return (
        Cost("training seconds", "training seconds", TRAINING, positive("train_seconds")),
        Cost("render milliseconds", "milliseconds per view", RENDERING, positive("render_ms")),
        Cost(f"{what} size", f"{what} MB", SIZE, positive(key, 1e-6)),
    )


def front(points: Sequence[tuple[float, float]], up: bool) -> list[tuple[float, float]]:
    """Compute the Pareto front of (cost, quality) points, cheapest first, without duplicates. `points`: costs (lower is
    better) and qualities. `up`: higher quality is better (PSNR), else lower (FLIP)."""
    best: list[tuple[float, float]] = []
    for cost, quality in sorted(set(points), key=lambda p: (p[0], -p[1] if up else p[1])):
        if not best or (quality > best[-1][1] if up else quality < best[-1][1]):
            best.append((cost, quality))
    return best


def draw_plots(evaluations: list[Evaluation], curves: list[Curve]) -> list[Plot]:
    """Draw all plots that have a panel with at least MIN_POINTS points."""
    names = dict.fromkeys([*sorted({e.method for e in evaluations}), *sorted({c.label for c in curves})])
    colors = {name: COLORS[i % len(COLORS)] for i, name in enumerate(names)}
    plots = [_curve_plot(*axes, curves, colors) for axes in CURVES]
    plots += [_pareto_plot(key, cost, evaluations, colors) for cost in costs(evaluations) for key in METRICS]
    return [plot for plot in plots if plot is not None]


def _curve_plot(
    title: str, x: str, y: str, keys: tuple[str, str], curves: list[Curve], colors: dict[str, str]
) -> Plot | None:
    drawn = [c for c in curves if c.series(*keys)[0]]
    if max((len(c.series(*keys)[0]) for c in drawn), default=0) < MIN_POINTS:
        return None

    def panel(axes: Axes, scene: str) -> None:
        for curve in drawn:
            if curve.scene == scene:
                xs, ys = curve.series(*keys)
                marker = "o" if len(xs) <= 20 else ""
                axes.plot(xs, ys, color=colors[curve.label], linewidth=1.6, marker=marker, ms=3)
        if keys[1] == "surfels":
            axes.set_ylim(bottom=0)

    legend = [Line2D([], [], color=colors[label], label=label) for label in sorted({c.label for c in drawn})]
    scenes = sorted({c.scene for c in drawn})
    return Plot(title, TRAINING, len(scenes), _png(scenes, panel, x, y, legend), front=False)


def pareto_panel(
    axes: Axes, rows: list[Evaluation], key: str, cost: Cost, colors: dict[str, str], markers: dict[str, str]
) -> None:
    """Draw quality against cost of one scene: hollow circles for trained scenes, filled markers for bundles, a line per
    method, and the Pareto front of all points."""
    _, up, span = METRICS[key]
    points = {id(e): (cost.value(e), e.get(key)) for e in rows}
    best = front(list(points.values()), up)
    if len(best) > 1:
        xs, ys = zip(*best, strict=True)
        axes.step(xs, ys, where="post", color=INK, linewidth=0.9, linestyle=(0, (4, 3)), alpha=0.6, zorder=1)
    for method in sorted({e.method for e in rows}):
        xs, ys = zip(*sorted(points[id(e)] for e in rows if e.method == method), strict=True)
        axes.plot(xs, ys, color=colors[method], linewidth=0.9, alpha=0.55, zorder=2)
    for e in rows:
        x, y = points[id(e)]
        mark: dict[str, Any] = {"color": colors[e.method], "linestyle": "", "zorder": 3}
        if e.baked:
            axes.plot([x], [y], marker=markers[_variant(e)], ms=6, **mark)
        else:
            axes.plot([x], [y], marker="o", ms=7, markerfacecolor="white", markeredgewidth=1.8, **mark)
    axes.margins(0.12)
    low, high = (f(y for _, y in points.values()) for f in (min, max))
    if high - low < span:  # do not exaggerate differences in the third decimal
        axes.set_ylim((low + high) / 2 - 0.6 * span, (low + high) / 2 + 0.6 * span)
    _log_when_wide(axes, [x for x, _ in points.values()])


def _pareto_plot(key: str, cost: Cost, evaluations: list[Evaluation], colors: dict[str, str]) -> Plot | None:
    drawn = [e for e in evaluations if cost.value(e) is not None and e.get(key) is not None]
    if max(Counter(e.scene for e in drawn).values(), default=0) < MIN_POINTS:
        return None
    variants = sorted({_variant(e) for e in drawn if e.baked})
    markers = {variant: MARKERS[i % len(MARKERS)] for i, variant in enumerate(variants)}
    legend = [Line2D([], [], color=colors[m], label=m, linewidth=4) for m in sorted({e.method for e in drawn})]
    mark = {"color": INK, "linestyle": ""}
    if any(not e.baked for e in drawn):
        hollow = {"markerfacecolor": "white", "markeredgewidth": 1.8}
        legend.append(Line2D([], [], marker="o", ms=7, label="trained", **hollow, **mark))
    legend += [
        Line2D([], [], marker=marker, ms=6, label=f"baked, {variant}" if variant else "baked", **mark)
        for variant, marker in markers.items()
    ]
    legend.append(Line2D([], [], color=INK, linestyle=(0, (4, 3)), linewidth=0.9, label="Pareto front"))
    scenes = sorted({e.scene for e in drawn})

    def panel(axes: Axes, scene: str) -> None:
        pareto_panel(axes, [e for e in drawn if e.scene == scene], key, cost, colors, markers)

    png = _png(scenes, panel, cost.label, METRICS[key][0], legend)
    title = f"{METRICS[key][0].removesuffix(' (dB)')} against {cost.title}"
    return Plot(title, cost.section, len(scenes), png, front=True)


def _variant(row: Evaluation) -> str:
    """Strip the method from a label, which leaves the atlas format or another distinguishing suffix."""
    return (row.group or row.label).removeprefix(row.method).strip(", ()")


def _log_when_wide(axes: Axes, values: list[float]) -> None:
    if min(values) > 0 and max(values) / min(values) > 8:
        axes.set_xscale("log")
        narrow = math.log10(max(values) / min(values)) < 2
        axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5) if narrow else (1,), numticks=12))
        axes.xaxis.set_minor_formatter(NullFormatter())


@style.context(PLAIN)
def _png(scenes: list[str], panel: Callable[[Axes, str], None], x: str, y: str, legend: list[Line2D]) -> bytes:
    """Draw a figure: at most three panels per row, one legend below."""
    columns = min(3, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    width, height = (6.4, 3.9) if columns == 1 else (3.5 * columns, 2.9)
    figure = Figure(figsize=(width, rows * height), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    plain = FuncFormatter(lambda value, _: f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}")
    grid = figure.subplots(rows, columns, squeeze=False)
    for i, axes in enumerate(grid.flat):
        if i >= len(scenes):
            axes.remove()
            continue
        panel(axes, scenes[i])
        axes.grid(True, color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8, length=3, which="both")
        axes.xaxis.set_major_formatter(plain)
        axes.yaxis.set_major_formatter(plain)
        axes.spines[["top", "right"]].set_visible(False)
        if len(scenes) > 1:
            axes.set_title(scenes[i] or "no scene named", fontsize=9)
        if i + columns >= len(scenes):
            axes.set_xlabel(x, fontsize=9)
        if i % columns == 0:
            axes.set_ylabel(y, fontsize=9)
    if len(legend) > 1:
        longest = max(len(handle.get_label()) for handle in legend)
        ncols = max(1, min(len(legend), int(width * 16) // (longest + 7)))
        figure.legend(handles=legend, loc="outside lower center", frameon=False, fontsize=8, ncols=ncols)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": "bitymi report"})
    return buffer.getvalue()
