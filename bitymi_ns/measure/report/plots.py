"""Plots of a report: training curves, and quality against cost with Pareto fronts."""

from collections import Counter
from collections.abc import Sequence
from itertools import cycle
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ..figure import COLORS, INK, log_when_wide, panels, png, styled
from .records import Curve, Evaluation

MARKERS = "s^DvPX*p<>hd8H"  # of bundles, one per format
HOLLOW: dict[str, Any] = {"marker": "o", "ms": 7, "markerfacecolor": "white", "markeredgewidth": 1.8}
"""Marker of trained scenes."""
DASHES: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (4, 3))}  # of Pareto fronts
TRAINING = "Error against training time"
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
MIN_POINTS = 3  # of a plot; for fewer the tables suffice


class Plot(NamedTuple):
    title: str
    section: str  # of the page
    panels: int
    png: bytes


class Cost(NamedTuple):
    """A cost axis."""

    label: str
    section: str  # of the page
    key: str  # of the results
    factor: float = 1.0  # to the axis's unit

    def value(self, row: Evaluation) -> float | None:
        """Return the cost of an evaluation; None if it is unknown or 0."""
        return row.results.get(self.key, 0.0) * self.factor or None


COSTS = (
    Cost("training seconds", TRAINING, "train_seconds"),
    Cost("milliseconds per view", "Error against rendering time", "render_ms"),
    Cost("bundle MB", "Error against size", "bundle_bytes", 1e-6),
)


def front(points: Sequence[tuple[float, float]], up: bool) -> list[tuple[float, float]]:
    """Compute the Pareto front of (cost, quality) points, cheapest first. `up`: higher quality is better, else
    lower."""
    best: list[tuple[float, float]] = []
    for cost, quality in sorted(set(points), key=lambda p: (p[0], -p[1] if up else p[1])):
        if not best or (quality > best[-1][1] if up else quality < best[-1][1]):
            best.append((cost, quality))
    return best


@styled
def draw_plots(evaluations: list[Evaluation], curves: list[Curve]) -> list[Plot]:
    """Draw all plots that have a panel with at least MIN_POINTS points."""
    names = dict.fromkeys([*sorted({e.method for e in evaluations}), *sorted({c.label for c in curves})])
    colors = dict(zip(names, cycle(COLORS), strict=False))
    plots = [curve_plot(*axes, curves, colors) for axes in CURVES]
    plots += [pareto_plot(key, cost, evaluations, colors) for cost in COSTS for key in METRICS]
    return [plot for plot in plots if plot is not None]


def curve_plot(
    title: str, x: str, y: str, keys: tuple[str, str], curves: list[Curve], colors: dict[str, str]
) -> Plot | None:
    """Draw a column of training curves over another one; None if no curve has enough points."""
    lines = [(curve, *curve.series(*keys)) for curve in curves]
    lines = [line for line in lines if line[1]]
    if max((len(xs) for _, xs, _ in lines), default=0) < MIN_POINTS:
        return None
    scenes = sorted({curve.scene for curve, *_ in lines})
    figure, axes = panels([scene or "no scene named" for scene in scenes], x, y)
    for curve, xs, ys in lines:
        marker, panel = "o" if len(xs) <= 20 else "", axes[scenes.index(curve.scene)]
        panel.plot(xs, ys, color=colors[curve.label], linewidth=1.6, marker=marker, ms=3)
        if keys[1] == "surfels":
            panel.set_ylim(bottom=0)
    labels = sorted({curve.label for curve, *_ in lines})
    legend = [Line2D([], [], color=colors[label], label=label) for label in labels]
    return Plot(title, TRAINING, len(scenes), png(figure, legend))


def pareto_panel(
    axes: Axes, rows: list[Evaluation], key: str, cost: Cost, colors: dict[str, str], markers: dict[str, str]
) -> None:
    """Draw quality against cost of one scene: trained scenes, bundles, a line per method, and the Pareto front."""
    _, up, span = METRICS[key]
    points = [(x, e.results[key]) for e in rows if (x := cost.value(e)) is not None]
    best = front(points, up)
    if len(best) > 1:
        axes.step(*zip(*best, strict=True), where="post", color=INK, alpha=0.6, zorder=1, **DASHES)
    for method in sorted({e.method for e in rows}):
        line = sorted(point for e, point in zip(rows, points, strict=True) if e.method == method)
        axes.plot(*zip(*line, strict=True), color=colors[method], linewidth=0.9, alpha=0.55, zorder=2)
    for e, (x, y) in zip(rows, points, strict=True):
        mark = {"marker": markers[_variant(e)], "ms": 6} if e.baked else HOLLOW
        axes.plot([x], [y], color=colors[e.method], linestyle="", zorder=3, **mark)
    axes.margins(0.12)
    low, high = (f(y for _, y in points) for f in (min, max))
    if high - low < span:  # do not exaggerate differences in the third decimal
        axes.set_ylim((low + high) / 2 - 0.6 * span, (low + high) / 2 + 0.6 * span)
    log_when_wide(axes, [x for x, _ in points])


def pareto_plot(key: str, cost: Cost, evaluations: list[Evaluation], colors: dict[str, str]) -> Plot | None:
    """Draw quality against cost, a panel per scene; None if no scene has enough points."""
    drawn = [e for e in evaluations if cost.value(e) is not None and key in e.results]
    if max(Counter(e.scene for e in drawn).values(), default=0) < MIN_POINTS:
        return None
    markers = dict(zip(sorted({_variant(e) for e in drawn if e.baked}), cycle(MARKERS), strict=False))
    legend = [Line2D([], [], color=colors[m], label=m, linewidth=4) for m in sorted({e.method for e in drawn})]
    mark: dict[str, Any] = {"color": INK, "linestyle": ""}
    if any(not e.baked for e in drawn):
        legend.append(Line2D([], [], label="trained", **HOLLOW, **mark))
    for variant, marker in markers.items():
        label = f"baked, {variant}" if variant else "baked"
        legend.append(Line2D([], [], marker=marker, ms=6, label=label, **mark))
    legend.append(Line2D([], [], color=INK, label="Pareto front: no point is better in both", **DASHES))
    scenes, quality = sorted({e.scene for e in drawn}), METRICS[key][0]
    figure, axes = panels(scenes, cost.label, quality)
    for panel, scene in zip(axes, scenes, strict=True):
        pareto_panel(panel, [e for e in drawn if e.scene == scene], key, cost, colors, markers)
    title = f"{quality.removesuffix(' (dB)')} against {cost.label}"
    return Plot(title, cost.section, len(scenes), png(figure, legend))


def _variant(row: Evaluation) -> str:
    """Strip the method from a label, which leaves the bundle's name."""
    return (row.group or row.label).removeprefix(row.method).strip(", ()")
