"""The estimate of the time left, and what is shown."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from bitymi_ns.measure.bench import Cells, Matrix, Stage
from bitymi_ns.measure.bench.progress import Display, Estimate, duration


def test_the_estimate_learns_from_what_is_most_alike(matrix: Matrix, tmp_path: Path) -> None:
    cells = Cells(tmp_path / "cells.jsonl")
    fox, _, lego, _ = matrix.runs()
    longer = Matrix(matrix.scenes, matrix.rows, (), 300).runs()[0]
    estimate = Estimate(cells)
    assert estimate.seconds(Stage(fox, "train")) is None
    cells.add(Stage(longer, "train").key, {}, {"seconds": 60.0})
    estimate = Estimate(cells)
    assert estimate.seconds(Stage(fox, "train")) == pytest.approx(20.0)  # a third of the steps
    estimate.add(Stage(lego, "train"), 10.0)
    assert estimate.seconds(Stage(fox, "train")) == pytest.approx(10.0)
    estimate.add(Stage(fox, "train"), 30.0)
    assert estimate.seconds(Stage(fox, "train")) == pytest.approx(30.0)
    assert estimate.seconds(Stage(fox, "eval")) is None
    assert estimate.total([Stage(fox, "train"), Stage(lego, "train"), Stage(fox, "eval")]) == (40.0, 1)


def test_the_display_counts_finished_and_failed_cells(matrix: Matrix, tmp_path: Path) -> None:
    cells = Cells(tmp_path / "cells.jsonl")
    chain = matrix.chains()[0]
    cells.add(chain[0].key, {}, {"seconds": 4.0})
    out = io.StringIO()
    with Display([chain], cells, console=Console(file=out, width=200)) as display:
        assert display.left() == "time left unknown"
        display.started(chain[1])
        display.finished(chain[1], 100.0)
        display.failed(chain[2], "broken")
        display.failed(chain[3], "")
        assert len(display.pending) == 2
    text = out.getvalue()
    assert "1 of 6 cells are finished already" in text
    assert "evaluation (trained): 2 min" in text and "export (bc7): failed" in text and "left out" in text


@pytest.mark.parametrize(("seconds", "text"), [(4.2, "4 s"), (300, "5 min"), (7200, "2.0 h")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text
