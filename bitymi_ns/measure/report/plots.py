"""Plots of a report: training curves, and quality against cost with Pareto fronts; one panel per scene."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from bitymi_ns.measure.figure import COLORS, INK, Panel, log_when_wide, png
from bitymi_ns.measure.report.records import Curve, Evaluation

MARKERS = ("s", "^", "D", "v", "P", "X", "*", "p", "<", ">", "h", "d", "8", "H")
"""Markers of bundles, one per format."""
HOLLOW = {"marker": "o", "ms": 7, "markerfacecolor": "white", "markeredgewidth": 1.8}  # of trained scenes
DASHES = {"linewidth": 0.9, "linestyle": (0, (4, 3))}  # of Pareto fronts
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
        return lambda e: (e.results.get(key) or 0.0) * scale or None

    baked = [e for e in rows if e.baked]
    what = "bundle" if baked and all(e.results.get("bundle_bytes") for e in baked) else "atlas"
    return (
        Cost("training seconds", "training seconds", TRAINING, positive("train_seconds")),
        Cost("render milliseconds", "milliseconds per view", RENDERING, positive("render_ms")),
        Cost(f"{what} size", f"{what} MB", SIZE, positive(f"{what}_bytes", 1e-6)),
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
    plots += [pareto_plot(key, cost, evaluations, colors) for cost in costs(evaluations) for key in METRICS]
    return [plot for plot in plots if plot is not None]


def _curve_plot(
    title: str, x: str, y: str, keys: tuple[str, str], curves: list[Curve], colors: dict[str, str]
) -> Plot | None:
    drawn = [c for c in curves if c.series(*keys)[0]]
    if max((len(c.series(*keys)[0]) for c in drawn), default=0) < MIN_POINTS:
        return None

    def panel(scene: str, axes: Axes) -> None:
        for curve in drawn:
            if curve.scene == scene:
                xs, ys = curve.series(*keys)
                marker = "o" if len(xs) <= 20 else ""
                axes.plot(xs, ys, color=colors[curve.label], linewidth=1.6, marker=marker, ms=3)
        if keys[1] == "surfels":
            axes.set_ylim(bottom=0)

    legend = [Line2D([], [], color=colors[label], label=label) for label in sorted({c.label for c in drawn})]
    return _of_scenes(title, TRAINING, sorted({c.scene for c in drawn}), panel, x, y, legend)


def _of_scenes(
    title: str, section: str, scenes: list[str], panel: Callable[[str, Axes], None], x: str, y: str,
    legend: list[Line2D], front: bool = False,
) -> Plot:  # fmt: skip
    panels = [Panel(partial(panel, scene), scene or "no scene named", x, y) for scene in scenes]
    return Plot(title, section, len(scenes), png(panels, legend), front)


def pareto_panel(
    axes: Axes, rows: list[Evaluation], key: str, cost: Cost, colors: dict[str, str], markers: dict[str, str]
) -> None:
    """Draw quality against cost of one scene: hollow circles for trained scenes, filled markers for bundles, a line per
    method, and the Pareto front of all points."""
    _, up, span = METRICS[key]
    points = {id(e): (cost.value(e), e.results.get(key)) for e in rows}
    best = front(list(points.values()), up)
    if len(best) > 1:
        axes.step(*zip(*best, strict=True), where="post", color=INK, alpha=0.6, zorder=1, **DASHES)
    for method in sorted({e.method for e in rows}):
        line = sorted(points[id(e)] for e in rows if e.method == method)
        axes.plot(*zip(*line, strict=True), color=colors[method], linewidth=0.9, alpha=0.55, zorder=2)
    for e in rows:
        mark = {"marker": markers[_variant(e)], "ms": 6} if e.baked else HOLLOW
        x, y = points[id(e)]
        axes.plot([x], [y], color=colors[e.method], linestyle="", zorder=3, **mark)
    axes.margins(0.12)
    low, high = (f(y for _, y in points.values()) for f in (min, max))
    if high - low < span:  # do not exaggerate differences in the third decimal
        axes.set_ylim((low + high) / 2 - 0.6 * span, (low + high) / 2 + 0.6 * span)
    log_when_wide(axes, [x for x, _ in points.values()])


def pareto_plot(key: str, cost: Cost, evaluations: list[Evaluation], colors: dict[str, str]) -> Plot | None:
    """Draw quality against cost, a panel per scene; None if no scene has enough points."""
    drawn = [e for e in evaluations if cost.value(e) is not None and e.results.get(key) is not None]
    if max(Counter(e.scene for e in drawn).values(), default=0) < MIN_POINTS:
        return None
    variants = sorted({_variant(e) for e in drawn if e.baked})
    markers = {variant: MARKERS[i % len(MARKERS)] for i, variant in enumerate(variants)}
    legend = [Line2D([], [], color=colors[m], label=m, linewidth=4) for m in sorted({e.method for e in drawn})]
    mark = {"color": INK, "linestyle": ""}
    if any(not e.baked for e in drawn):
        legend.append(Line2D([], [], label="trained", **HOLLOW, **mark))
    names = {variant: f"baked, {variant}" if variant else "baked" for variant in variants}
    legend += [Line2D([], [], marker=markers[v], ms=6, label=name, **mark) for v, name in names.items()]
    legend.append(Line2D([], [], color=INK, label="Pareto front", **DASHES))

    def panel(scene: str, axes: Axes) -> None:
        pareto_panel(axes, [e for e in drawn if e.scene == scene], key, cost, colors, markers)

    title = f"{METRICS[key][0].removesuffix(' (dB)')} against {cost.title}"
    scenes = sorted({e.scene for e in drawn})
    return _of_scenes(title, cost.section, scenes, panel, cost.label, METRICS[key][0], legend, front=True)


def _variant(row: Evaluation) -> str:
    """Strip the method from a label, which leaves the atlas format or another distinguishing suffix."""
    return (row.group or row.label).removeprefix(row.method).strip(", ()")
