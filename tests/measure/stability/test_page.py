"""The error page on a few scenes."""

import dataclasses
from pathlib import Path

import pytest

from bitymi_ns import cli
from bitymi_ns.measure.stability import page
from bitymi_ns.measure.stability.errors import BACKENDS
from bitymi_ns.measure.stability.scenes import random_scene


def test_the_page_and_its_plot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    short = tuple(dataclasses.replace(sweep, values=sweep.values[:1]) for sweep in page.SWEEPS)
    first, second, *_ = page.extreme_scenes()
    scenes = [dataclasses.replace(first, name="edge_on, <1"), second]
    monkeypatch.setattr(page, "SWEEPS", short)
    monkeypatch.setattr(page, "extreme_scenes", lambda: scenes)
    target = tmp_path / "deep" / "numbers.md"
    assert cli.main(["stability", "--output", str(target)]) == 0
    text = target.read_text("utf8")
    assert "(numbers.png)" in text and (tmp_path / "deep" / "numbers.png").read_bytes().startswith(b"\x89PNG")
    assert text.count("1 of 2 cases are accurate") == 3
    assert "accurate, 3 as the inputs allow, 0 loses figures" in text and "| edge on, <1 |" in text  # not escaped
    assert sorted(path.name for path in target.parent.iterdir()) == ["numbers.md", "numbers.png"]
    assert "14 scenes, 0 of them" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(["stability", "--backend", "abacus"])
    assert "invalid choice 'abacus'" in capsys.readouterr().err


def test_verdicts() -> None:
    row = page.measure_row("easy", random_scene(3, 0, 8, 8), BACKENDS["cpu"])
    assert row.verdict == "accurate" and max(row.double.forward, row.double.gradient) < 1e-10

    def verdict(**changes: float) -> str:
        return row._replace(single=row.single._replace(**changes)).verdict

    assert verdict(finite=False) == "**not finite**"
    assert verdict(drawn=0) == "nothing drawn"
    assert verdict(gradient=1e-3, input_gradient=5e-4) == "as the inputs allow"
    assert verdict(gradient=1e-3, input_gradient=1e-5) == "**loses figures**"
