"""The page docs/stability.md: errors of float32 in each case and along each kind of stiffness."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.ticker import LogLocator

from bitymi_ns.files import check_writable, write_file
from bitymi_ns.measure import markdown
from bitymi_ns.measure.figure import panels, png, styled
from bitymi_ns.measure.markdown import rendered
from bitymi_ns.measure.stability.errors import PROBES, Backend, Errors, measure
from bitymi_ns.measure.stability.scenes import PLAIN, RIM, SWEEPS, WAYS, SceneCase, Way, extreme_scenes

ACCURATE = 1e-4  # largest error that counts as accurate
ALLOWANCE = 4.0  # an error of at most this many times the effect of rounding the inputs is `LIMITED`
LIMITED, NOTHING = "as the inputs allow", "nothing drawn"  # verdicts


@dataclass(frozen=True)
class SceneErrors:
    """Errors measured on one scene."""

    label: str
    single: Errors  # of the kernels in float32
    double: Errors  # of the kernels in float64

    @property
    def exact(self) -> float:
        """Largest error of images and gradients of the kernels in float64."""
        return max(self.double.forward, self.double.gradient)

    @property
    def errors(self) -> tuple[float, float, float, float]:
        """Errors of the images, their errors from rounded inputs, and the same of the gradients."""
        e = self.single
        return e.forward, e.input_forward, e.gradient, e.input_gradient

    @property
    def verdict(self) -> str:
        """Verdict, as explained on the page."""
        both = (self.single, self.double)
        if not all(e.finite for e in both):
            return "**not finite**"
        if self.single.drawn == 0:
            return NOTHING
        pairs = [pair for e in both for pair in ((e.forward, e.input_forward), (e.gradient, e.input_gradient))]
        if all(error <= ACCURATE for error, _ in pairs):
            return "accurate"
        if all(error <= max(ACCURATE, ALLOWANCE * allowed) for error, allowed in pairs):
            return LIMITED
        return "**loses figures**"


def measure_row(label: str, scene: SceneCase, backend: Backend, near: float = 0.2, way: Way = PLAIN) -> SceneErrors:
    """Measure one scene in float32 and float64."""
    single, double = (measure(scene, backend, dtype, near, way) for dtype in (torch.float32, torch.float64))
    return SceneErrors(label, single, double)


def write(path: Path, backend: Backend, progress: Callable[[str], None]) -> list[SceneErrors]:
    """Measure all cases and sweeps, write the page and its plot `<stem>.png`, and return the rows."""
    picture = path.with_suffix(".png") if path.name else path
    for target in (path, picture):
        check_writable(target)
    named: dict[str, list[SceneErrors]] = {}
    for way in (PLAIN, *WAYS):
        progress(f"cases, {way.name}")
        named[way.name] = [
            measure_row(scene.name.replace("_", " "), scene, backend, way=way) for scene in extreme_scenes()
        ]
    swept: dict[str, list[SceneErrors]] = {}
    for sweep in SWEEPS:
        progress(f"sweep {sweep.name}")
        swept[sweep.name] = [
            measure_row(f"{value:g}", sweep.make(value), backend, sweep.near(value)) for value in sweep.values
        ]
    rows = [row for rows in (*named.values(), *swept.values()) for row in rows]
    counts = {"accurate": 0, LIMITED: 0, "loses figures": 0, **Counter(row.verdict.strip("*") for row in rows)}
    text = rendered(
        "stability.md.j2",
        backend=backend.name,
        rim=f"{RIM:g}",
        probes=PROBES,
        accurate=f"{ACCURATE:g}",
        steps=round(1 / (255 * ACCURATE)),
        allowance=f"{ALLOWANCE:g}",
        picture=picture.name,
        sweeps=_sweeps(swept),
        cases={name: _inexact([row for row in of_way if row.verdict != NOTHING]) for name, of_way in named.items()},
        verdicts=", ".join(f"{count} {verdict}" for verdict, count in counts.items() if verdict != NOTHING),
        nothing=", ".join(row.label for row in named[PLAIN.name] if row.verdict == NOTHING),
    )
    write_file(picture, _plot(swept), follow=True)
    write_file(path, text.encode(), follow=True)
    return rows


CASES = ("case", "forward", "inputs", "gradient", "inputs", "worst in", "flipped", "float64", "verdict")
SWEPT = ("kind", "values", "forward", "inputs", "gradient", "inputs", "float64", "not accurate at")


def _inexact(rows: Sequence[SceneErrors]) -> str:
    """Summarise the accurate cases with their largest errors, then format a line for each other case."""
    accurate = [row for row in rows if row.verdict == "accurate"]
    images, gradients = (_short(max((row.errors[i] for row in accurate), default=0.0)) for i in (0, 2))
    text = f"{len(accurate)} of {len(rows)} cases are accurate: images within {images}, gradients within {gradients}."
    lines = []
    for row in rows:
        if row.verdict != "accurate":
            worst = row.single.worst if row.single.gradient else ""
            flipped = f"{100 * row.single.flipped:.2g} %"
            lines.append([row.label, *map(_short, row.errors), worst, flipped, _short(row.exact), row.verdict])
    table = markdown.table(CASES, lines, (0, 5, len(CASES) - 1))
    return f"{text} The others:\n\n{table}" if lines else text


def _sweeps(swept: Mapping[str, Sequence[SceneErrors]]) -> str:
    """Format a line for each sweep: the largest errors, and the values whose verdict is not "accurate"."""
    lines = []
    for sweep in SWEEPS:
        rows = swept[sweep.name]
        errors = map(max, zip(*((*row.errors, row.exact) for row in rows), strict=True))
        labels = {LIMITED: "{0.label}", "accurate": ""}
        inexact = filter(None, (labels.get(row.verdict, "{0.label} ({0.verdict})").format(row) for row in rows))
        values = f"{rows[0].label} to {rows[-1].label}"
        lines.append([sweep.axis, values, *map(_short, errors), ", ".join(inexact) or "-"])
    return markdown.table(SWEPT, lines, (0, 1, len(SWEPT) - 1))


def _short(value: float) -> str:
    return f"{value:.1e}" if value else "0"


FORWARD, GRADIENT, DOUBLE = "#0b62b8", "#d1540b", "#6b6f76"
LINES = (
    ("float32 images", FORWARD, "-o"), ("rounded inputs, images", FORWARD, "--"), ("float32 gradients", GRADIENT, "-s"),
    ("rounded inputs, gradients", GRADIENT, "--"), ("float64 images", DOUBLE, ":"), ("float64 gradients", DOUBLE, "-."),
)  # fmt: skip
"""Lines of a panel: label, colour, style."""
LOWEST = 1e-17


@styled
def _plot(swept: dict[str, list[SceneErrors]]) -> bytes:
    """Draw the errors of each sweep over its values, stiffer to the right."""
    figure, axes = panels([sweep.name for sweep in SWEEPS], "", "error", most=4)
    for panel, sweep in zip(axes, SWEEPS, strict=True):
        rows = swept[sweep.name]
        columns = zip(*((*row.errors, row.double.forward, row.double.gradient) for row in rows), strict=True)
        for (label, color, style), values in zip(LINES, columns, strict=True):
            panel.plot(sweep.values, np.maximum(values, LOWEST), style, color=color, ms=4, lw=1.3, label=label)
        panel.set(xlabel=sweep.axis, xscale="log", yscale="log", ylim=(LOWEST / 2, 30))
        panel.xaxis.set_major_locator(LogLocator(numticks=5))
        if sweep.values[-1] < sweep.values[0]:
            panel.invert_xaxis()
    return png(figure, axes[0].get_lines())
