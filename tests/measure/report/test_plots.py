"""Pareto fronts, and the panel of bundles of several sizes."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from bitymi_ns.measure.report.plots import COSTS, front, pareto_panel
from bitymi_ns.measure.report.records import Evaluation


def bundle(form: str, psnr: float, whole: float, atlas: float) -> Evaluation:
    results = {"psnr": psnr, "atlas_bytes": atlas, "bundle_bytes": whole}
    return Evaluation("fox", "bitymi", True, f"bitymi, {form}", results, Path(form))


ROWS = [
    bundle("bc7", 31.95, 3.7e6, 0.52e6),
    bundle("compact", 31.96, 1.07e6, 0.61e6),
    bundle("compact-small", 31.7, 0.7e6, 0.4e6),
]


def test_sizes_are_of_the_download_and_the_bundles_of_a_method_lie_along_a_curve() -> None:
    size = COSTS[-1]
    assert [size.value(row) for row in ROWS] == pytest.approx([3.7, 1.07, 0.7])
    axes = Figure().add_subplot()
    markers = dict.fromkeys(("bc7", "compact", "compact-small"), "s")
    pareto_panel(axes, ROWS, "psnr", size, {"bitymi": "C0"}, markers)
    curves = [line for line in axes.lines if list(line.get_xdata()) == pytest.approx([0.7, 1.07, 3.7])]
    assert [list(line.get_ydata()) for line in curves] == [pytest.approx([31.7, 31.96, 31.95])]


@pytest.mark.parametrize(
    ("points", "up", "best"),
    [
        ([(1, 5), (2, 4), (3, 6), (3, 7), (1, 4)], True, [(1, 5), (3, 7)]),
        ([(1, 5), (2, 4), (3, 6), (2, 3)], False, [(1, 5), (2, 3)]),
        ([(2, 2), (2, 2)], True, [(2, 2)]),
        ([], True, []),
    ],
)
def test_fronts(points: list[tuple[float, float]], up: bool, best: list[tuple[float, float]]) -> None:
    assert front(points, up) == best
