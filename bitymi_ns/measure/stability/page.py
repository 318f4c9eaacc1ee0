"""The page docs/stability.md: errors of float32 on extreme scenes."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.ticker import LogLocator

from bitymi_ns.files import check_writable, write_file
from .. import markdown
from ..figure import panels, png, styled
from ..markdown import rendered
from .errors import PROBES, Backend, Errors, measure
from .scenes import PLAIN, RIM, SWEEPS, WAYS, SceneCase, Way, extreme_scenes

ACCURATE = 1e-4  # largest error that counts as accurate
ALLOWANCE = 4.0  # an error of at most so many times the effect of rounding the inputs is `LIMITED`
LIMITED, NOTHING = "as the inputs allow", "nothing drawn"  # verdicts


class SceneErrors(NamedTuple):
    """Errors on one scene."""

    label: str
    single: Errors  # of the kernels in float32
    double: Errors  # of the kernels in float64

    @property
    def verdict(self) -> str:
        both = (self.single, self.double)
        if not all(e.finite for e in both):
            return "**not finite**"
        if self.single.drawn == 0:
            return NOTHING
        pairs = [pair for e in both for pair in e.pairs]
        if all(error <= ACCURATE for error, _ in pairs):
            return "accurate"
        if all(error <= max(ACCURATE, ALLOWANCE * allowed) for error, allowed in pairs):
            return LIMITED
        return "**loses figures**"


def measure_row(label: str, scene: SceneCase, backend: Backend, near: float = 0.2, way: Way = PLAIN) -> SceneErrors:
    return SceneErrors(label, *(measure(scene, backend, dtype, near, way) for dtype in (torch.float32, torch.float64)))


def write(path: Path, backend: Backend, progress: Callable[[str], None]) -> list[SceneErrors]:
    """Measure all cases and sweeps, write the page and beside it its plot, and return the rows."""
    picture = path.with_suffix(".png") if path.name else path
    for target in (path, picture):
        check_writable(target)
    groups: dict[str, list[SceneErrors]] = {}
    for way in (PLAIN, *WAYS):
        progress(f"cases, {way.name}")
        groups[way.name] = [
            measure_row(scene.name.replace("_", " "), scene, backend, way=way) for scene in extreme_scenes()
        ]
    for sweep in SWEEPS:
        progress(f"sweep {sweep.name}")
        groups[sweep.name] = [
            measure_row(f"{sweep.name}, {value:g}", sweep.make(value), backend, sweep.near(value))
            for value in sweep.values
        ]
    rows = [row for group in groups.values() for row in group]
    swept = [row for sweep in SWEEPS for row in groups[sweep.name]]
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
        cases={name: _inexact(group) for name, group in (*groups.items(), ("sweeps", swept))},
        verdicts=", ".join(f"{count} {verdict}" for verdict, count in counts.items() if verdict != NOTHING),
        nothing=", ".join(row.label for row in groups[PLAIN.name] if row.verdict == NOTHING),
    )
    write_file(picture, _plot(groups), follow=True)
    write_file(path, text.encode(), follow=True)
    return rows


CASES = ("case", "forward", "inputs", "gradient", "inputs", "worst in", "flipped", "float64", "verdict")


def _inexact(rows: Sequence[SceneErrors]) -> str:
    """Summarise the accurate cases by their largest errors, and list the others."""
    rows = [row for row in rows if row.verdict != NOTHING]
    accurate = [row.single for row in rows if row.verdict == "accurate"]
    images = _short(max((e.forward for e in accurate), default=0.0))
    gradients = _short(max((e.gradient for e in accurate), default=0.0))
    text = f"{len(accurate)} of {len(rows)} cases are accurate: images within {images}, gradients within {gradients}."
    lines = []
    for row in rows:
        if row.verdict != "accurate":
            e, exact = row.single, max(row.double.forward, row.double.gradient)
            errors = [_short(error) for pair in e.pairs for error in pair]
            lines.append([row.label, *errors, e.worst, f"{100 * e.flipped:.2g} %", _short(exact), row.verdict])
    table = markdown.table(CASES, lines, (0, 5, len(CASES) - 1))
    return f"{text} The others:\n\n{table}" if lines else text


def _short(value: float) -> str:
    return f"{value:.1e}" if value else "0"


FORWARD, GRADIENT, DOUBLE = "#0b62b8", "#d1540b", "#6b6f76"
LINES = (
    ("float32 images", FORWARD, "-o"), ("rounded inputs, images", FORWARD, "--"), ("float32 gradients", GRADIENT, "-s"),
    ("rounded inputs, gradients", GRADIENT, "--"), ("float64 images", DOUBLE, ":"), ("float64 gradients", DOUBLE, "-."),
)  # fmt: skip
"""Lines of a panel: label, colour, style."""
LOWEST = 1e-17  # error drawn


@styled
def _plot(groups: dict[str, list[SceneErrors]]) -> bytes:
    """Draw the errors of each sweep, stiffer to the right."""
    figure, axes = panels([sweep.name for sweep in SWEEPS], "", "error", most=4)
    for panel, sweep in zip(axes, SWEEPS, strict=True):
        rows = groups[sweep.name]
        columns = zip(*((*row.single[:4], row.double.forward, row.double.gradient) for row in rows), strict=True)
        for (label, color, style), values in zip(LINES, columns, strict=True):
            panel.plot(sweep.values, np.maximum(values, LOWEST), style, color=color, ms=4, lw=1.3, label=label)
        panel.set(xlabel=sweep.axis, xscale="log", yscale="log", ylim=(LOWEST / 2, 30))
        panel.xaxis.set_major_locator(LogLocator(numticks=5))
        if sweep.values[-1] < sweep.values[0]:
            panel.invert_xaxis()
    return png(figure, axes[0].get_lines())
