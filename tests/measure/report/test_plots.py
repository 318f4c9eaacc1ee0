"""Pareto fronts, and the panel of bundles of several sizes."""

import pytest
from matplotlib.figure import Figure

from bitymi_ns.measure.report.plots import COSTS, front, pareto_panel
from tests.measure.report.conftest import make


def test_sizes_are_of_the_download_and_the_bundles_of_a_method_lie_along_a_curve() -> None:
    sizes = {3.7e6: (31.95, 0.52e6), 1.07e6: (31.96, 0.61e6), 0.7e6: (31.7, 0.4e6)}
    rows = [make(psnr=psnr, bundle_bytes=whole, atlas_bytes=atlas) for whole, (psnr, atlas) in sizes.items()]
    size = COSTS[-1]
    assert [size.value(row) for row in rows] == pytest.approx([3.7, 1.07, 0.7])
    axes = Figure().add_subplot()
    pareto_panel(axes, rows, "psnr", size, {"bitymi": "C0"}, {"": "s"})
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
