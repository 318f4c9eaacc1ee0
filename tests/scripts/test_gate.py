"""The gate: what passes and what fails."""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

GOOD = {
    "psnr_trained": 20.0, "psnr_baked": 21.0, "lpips_baked": 0.1, "bundle_bytes": 1000.0, "surfels": 100.0,
    "fragments_per_pixel": 10.0, "peak_mb": 500.0, "train": 80.0, "bake": 40.0, "frame": 0.5,
}  # fmt: skip


Run = Callable[..., int]


@pytest.fixture
def baseline(tmp_path: Path) -> Path:
    return tmp_path / "gate.json"


@pytest.fixture
def run(load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, baseline: Path) -> Run:
    """Return a function that runs the gate on measurements with changes of GOOD, the baseline, and returns how many it
    used."""
    gate = load("gate")

    def measured(*changes: dict[str, float], accept: bool = False) -> int:
        left = [{**GOOD, **change} for change in changes]
        monkeypatch.setattr(gate, "measure", lambda: left.pop(0))
        gate.main(baseline=baseline, accept=accept)
        return len(changes) - len(left)

    measured({}, accept=True)
    return measured


def test_equal_and_better_pass(run: Run, baseline: Path) -> None:
    assert json.loads(baseline.read_text())["figures"]["psnr_trained"] == 20.0
    assert run({}) == 1
    assert run({"psnr_trained": 25.0, "bundle_bytes": 10.0, "train": 1.0}) == 1


@pytest.mark.parametrize(
    ("figure", "passes", "fails"),
    [
        ("psnr_trained", 19.96, 19.94),
        ("psnr_baked", 20.96, 20.94),
        ("lpips_baked", 0.102, 0.104),
        ("bundle_bytes", 1029.0, 1031.0),
        ("surfels", 102.9, 103.1),
        ("fragments_per_pixel", 10.29, 10.31),
        ("peak_mb", 549.0, 551.0),
        ("train", 91.0, 93.0),
        ("bake", 45.0, 47.0),
        ("frame", 0.57, 0.58),
    ],
)
def test_each_limit(run: Run, figure: str, passes: float, fails: float, capsys: Any) -> None:
    run({figure: passes})
    with pytest.raises(SystemExit, match="1 of 10 figures are worse"):
        run({figure: fails}, {figure: fails})
    assert capsys.readouterr().out.count("WORSE") == 1


def test_times_are_taken_again_and_not_judged_elsewhere(run: Run, baseline: Path) -> None:
    assert run({"train": 200.0}, {}) == 2
    with pytest.raises(SystemExit, match="1 of 10"):
        run({"train": 200.0, "psnr_trained": 21.0}, {"train": 120.0})
    stated = json.loads(baseline.read_text())
    baseline.write_text(json.dumps({**stated, "processor": "another one"}))
    assert run({"train": 200.0, "psnr_trained": 19.91}) == 1
    for worse in ({"psnr_trained": 19.89}, {"surfels": 200.0}):
        with pytest.raises(SystemExit, match="1 of 10"):
            run(worse)
    stated["settings"]["steps"] += 1
    baseline.write_text(json.dumps(stated))
    with pytest.raises(SystemExit, match="the baseline is of"):
        run({})
