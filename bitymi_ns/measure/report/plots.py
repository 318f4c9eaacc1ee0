"""The plots of a report: error against training time, rendering time and size, with Pareto fronts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.axes import Axes

from bitymi_ns.measure.report.drawing import Plot, Sheet, Theme, draw, line_color, log_when_wide
from bitymi_ns.measure.report.knob_plots import knob_sheets
from bitymi_ns.measure.report.pareto import front
from bitymi_ns.measure.report.records import Curve, Evaluation, Records, trained_parent

MARKERS = ("s", "^", "D", "v", "P", "X", "*", "p", "<", ">", "h", "d", "8", "H")
"""Marks of baked evaluations, one per format."""
TRAINING, RENDERING, SIZE = "Error against training time", "Error against rendering time", "Error against size"
"""Headings of the page's sections of plots."""
CURVES = ("psnr_seconds", "psnr_cpu_seconds", "surfels_steps")
"""Names of the plots of training curves, which have no Pareto front."""
MIN_POINTS = 3
"""Plots of fewer points are left out: the tables say the same."""


@dataclass(frozen=True)
class Metric:
    """A measure of quality: key of its result, name, whether more is better, and the least span of its axis."""

    key: str
    title: str
    up: bool
    span: float


METRICS = (
    Metric("psnr", "PSNR (dB)", True, 0.5),
    Metric("ssim", "SSIM", True, 0.01),
    Metric("flip", "FLIP", False, 0.01),
    Metric("lpips", "LPIPS", False, 0.01),
    Metric("lpips_vgg", "LPIPS (VGG)", False, 0.01),
)


@dataclass(frozen=True)
class Cost:
    """What quality is bought with: name in file names, axis label, section, value, whether baking changes it, and
    whether the bundles of a method lie along a curve."""

    name: str
    title: str
    label: str
    section: str
    value: Callable[[Evaluation], float | None]
    arrows: bool
    curve: bool = False


def _positive(key: str, scale: float = 1.0) -> Callable[[Evaluation], float | None]:
    return lambda e: (e.get(key) or 0.0) * scale or None


def costs(rows: list[Evaluation]) -> tuple[Cost, ...]:
    """The x axes. Sizes are of whole bundles, which is what is downloaded, where all bundles state them; else of their
    atlases."""
    baked = [e for e in rows if e.baked]
    whole = bool(baked) and all(e.get("bundle_bytes") for e in baked)
    key, what = ("bundle_bytes", "bundle") if whole else ("atlas_bytes", "atlas")
    return (
        Cost("train_seconds", "training seconds", "training seconds", TRAINING, _positive("train_seconds"), False),
        Cost("render_ms", "render milliseconds", "milliseconds per view", RENDERING, _positive("render_ms"), True),
        Cost("bytes", f"{what} size", f"{what} MB", SIZE, _positive(key, 1e-6), False, True),
    )


def _curve_sheet(name: str, title: str, x: str, y: str, keys: tuple[str, str], curves: list[Curve],
                 colors: dict[str, int]) -> Sheet | None:  # fmt: skip
    """`keys[1]` against `keys[0]` of every curve that records both at least once."""
    drawn = [c for c in curves if c.series(*keys)[0]]
    if not drawn:
        return None

    def panel(axes: Axes, scene: str, theme: Theme) -> None:
        for curve in drawn:
            if curve.scene == scene:
                xs, ys = curve.series(*keys)
                marker = "o" if len(xs) <= 20 else ""
                axes.plot(xs, ys, color=line_color(theme, colors[curve.label]), linewidth=1.6, marker=marker, ms=3)
        if keys[1] == "surfels":
            axes.set_ylim(bottom=0)

    labels = sorted({c.label for c in drawn})
    legend = tuple((label, {"color": colors[label], "linewidth": 2}) for label in labels)
    return Sheet(name, title, TRAINING, x, y, tuple(sorted({c.scene for c in drawn})), panel,
                 max(len(c.series(*keys)[0]) for c in drawn), legend)  # fmt: skip


def _scatter_sheet(metric: Metric, cost: Cost, evaluations: list[Evaluation], colors: dict[str, int]) -> Sheet | None:
    """Quality against cost: hollow circles before baking, filled marks after, a thin line from parent to bundle or
    through the bundles of a method, and the Pareto front of all points of a scene."""
    points = {id(e): (cost.value(e), e.get(metric.key)) for e in evaluations}
    drawn = [e for e in evaluations if None not in points[id(e)]]
    if not drawn:
        return None
    variants = sorted({_variant(e) for e in drawn if e.baked})
    markers = {variant: MARKERS[i % len(MARKERS)] for i, variant in enumerate(variants)}

    def panel(axes: Axes, scene: str, theme: Theme) -> None:
        here = [e for e in drawn if e.scene == scene]
        best = front([points[id(e)] for e in here], metric.up)
        if len(best) > 1:
            xs, ys = zip(*best, strict=True)
            axes.step(xs, ys, where="post", color=theme.ink, linewidth=0.9, linestyle=(0, (4, 3)), alpha=0.6, zorder=1)
        for method in sorted({e.method for e in here}) if cost.curve else ():
            xs, ys = zip(*sorted(points[id(e)] for e in here if e.method == method), strict=True)
            axes.plot(xs, ys, color=line_color(theme, colors[method]), linewidth=0.9, alpha=0.55, zorder=2)
        for e in here:
            color = line_color(theme, colors[e.method])
            px, py = points[id(e)]
            if e.baked:
                parent = trained_parent(e, drawn) if cost.arrows else None
                if parent is not None:
                    qx, qy = points[id(parent)]
                    axes.plot([qx, px], [qy, py], color=color, linewidth=0.9, alpha=0.55, zorder=2)
                axes.plot([px], [py], color=color, marker=markers[_variant(e)], ms=6, linestyle="", zorder=3)
            else:
                axes.plot([px], [py], color=color, marker="o", ms=7, linestyle="", zorder=3,
                          markerfacecolor=theme.paper, markeredgewidth=1.8)  # fmt: skip
        axes.margins(0.12)
        _at_least(axes, [points[id(e)][1] for e in here], metric.span)
        log_when_wide(axes, [points[id(e)][0] for e in here])

    legend: list[tuple[str, dict]] = [
        (method, {"color": colors[method], "linewidth": 4}) for method in sorted({e.method for e in drawn})
    ]
    if any(not e.baked for e in drawn):
        legend.append(("pre-bake", {"marker": "o", "ms": 7, "linestyle": "", "hollow": True, "markeredgewidth": 1.8}))
    legend += [
        (f"post-bake, {variant}" if variant else "post-bake", {"marker": marker, "ms": 6, "linestyle": ""})
        for variant, marker in markers.items()
    ]
    if len(drawn) > 1:
        legend.append(("Pareto front", {"linestyle": (0, (4, 3)), "linewidth": 0.9}))
    scenes = tuple(sorted({e.scene for e in drawn}))
    name, title = f"{metric.key}_{cost.name}", f"{metric.title.split()[0]} against {cost.title}"
    most = max(Counter(e.scene for e in drawn).values())
    return Sheet(name, title, cost.section, cost.label, metric.title, scenes, panel, most, tuple(legend))


def _at_least(axes: Axes, values: list[float], span: float) -> None:
    """A y axis of at least `span`, so that differences in the third decimal do not look like cliffs."""
    low, high = min(values), max(values)
    if high - low < span:
        middle = (low + high) / 2
        axes.set_ylim(middle - 0.6 * span, middle + 0.6 * span)


def _variant(row: Evaluation) -> str:
    """What a label says beyond the method: the atlas format, or what tells it from its namesakes."""
    return (row.group or row.label).removeprefix(row.method).strip(", ()")


def draw_plots(records: Records) -> list[Plot]:
    """Every plot for which there are enough data."""
    rows, curves = records.evaluations, records.curves
    names = dict.fromkeys([*sorted({e.method for e in rows}), *sorted({c.label for c in curves})])
    colors = {name: i for i, name in enumerate(names)}
    psnr = "PSNR (dB)"
    sheets = [
        _curve_sheet("psnr_seconds", "PSNR in the course of training", "training seconds", psnr,
                     ("seconds", "psnr"), curves, colors),
        _curve_sheet("psnr_cpu_seconds", "PSNR in the course of training, by CPU seconds", "CPU seconds", psnr,
                     ("cpu_seconds", "psnr"), curves, colors),
        _curve_sheet("surfels_steps", "Surfels over training steps", "step", "surfels",
                     ("step", "surfels"), curves, colors),
    ]  # fmt: skip
    sheets += [_scatter_sheet(metric, cost, rows, colors) for cost in costs(rows) for metric in METRICS]
    sheets += knob_sheets(records.knobs)
    return [draw(sheet) for sheet in sheets if sheet is not None and sheet.points >= MIN_POINTS]


def is_plot_name(name: str) -> bool:
    """Whether `draw_plots` could have given a plot this name."""
    known = set(CURVES) | {f"{metric.key}_{cost.name}" for metric in METRICS for cost in costs([])}
    return name in known or name.startswith("knob_")
