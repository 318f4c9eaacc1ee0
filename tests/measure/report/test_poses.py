"""How the camera poses of a capture were found, in the report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from bitymi_ns.measure.report import build
from tests.measure.report.test_build import pictures

FOUND: dict[str, Any] = {
    "source": "/photos/garden",
    "given": 42,
    "registered": 39,
    "reprojection_error": 0.7312,
    "track_length": 4.256,
    "points": 12_345,
    "parallax_degrees": 11.04,
    "metres_per_unit": 1.0,
    "gps_error": 2.34,
    "left_out": {"IMG <1>.jpg": "no other photograph shows the same", "IMG_2.jpg": "it cannot be read"},
    "notes": {"IMG_3.jpg": "blurred"},
    "seconds": {"finding features": 12.34, "all": 56.78},
}


def write(folder: Path, **changes: Any) -> Path:
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(json.dumps({**FOUND, **changes}))
    Image.new("RGB", (120, 60), "white").save(folder / "cameras.png")
    return folder / "report.json"


def text_of(inputs: list[Path], out: Path) -> tuple[str, str]:
    build(inputs, out)
    return (out / "index.html").read_text("utf8"), (out / "report.md").read_text("utf8")


def test_it_is_found_in_a_runs_folder_and_says_what_was_found(results: Path, tmp_path: Path) -> None:
    run = next(results.glob("outputs/fox/bitymi/*"))
    page, _ = text_of([results], tmp_path / "without")
    assert "Camera poses" not in page
    write(run / "poses")
    html, markdown = text_of([results], tmp_path / "with")
    assert len(pictures(html)) == len(pictures(page)) + 1
    for text in ("39 of 42", "0.73", "4.26", "12,345", "finding features", "12.3", "56.8", "/photos/garden"):
        assert text in html and text in markdown
    assert "z up by GPS, metres by GPS (median error 2.3 m)" in html
    assert "Left out: 2" in html and "no other photograph shows the same" in html and "blurred" in html
    assert "IMG &lt;1&gt;.jpg" in html and "<1>" not in html
    assert html.index("<h2>Training</h2>") < html.index("<h2>Camera poses</h2>")


def test_runs_of_one_capture_show_it_once(results: Path, tmp_path: Path) -> None:
    for run in results.glob("outputs/*/bitymi/*"):
        write(run / "poses")
    html, markdown = text_of([results], tmp_path / "report")
    assert html.count("39 of 42") == 1 and markdown.count("## Camera poses") == 1
    assert "1 capture whose poses were found" in html


def test_it_is_a_report_by_itself(tmp_path: Path) -> None:
    html, _ = text_of([write(tmp_path / "poses")], tmp_path / "report")
    assert "39 of 42" in html and len(pictures(html)) == 1


def test_of_many_photographs_some_are_named(tmp_path: Path) -> None:
    left_out = {f"{i:03d}.jpg": "blurred" for i in range(100)}
    html, _ = text_of([write(tmp_path / "poses", left_out=left_out)], tmp_path / "report")
    assert "Left out: 100" in html and "059.jpg" in html and "060.jpg" not in html and "And 40 more" in html


@pytest.mark.parametrize(
    "changes",
    [{name: None for name in FOUND}, {name: [1] for name in FOUND}, {name: {"a": {}} for name in FOUND}],
    ids=["null", "lists", "objects"],
)
def test_whatever_stands_in_it_is_no_error(changes: dict[str, Any], tmp_path: Path) -> None:
    file = write(tmp_path / "poses", **changes)
    (file.parent / "cameras.png").write_bytes(b"no picture")
    html, _ = text_of([file.parent], tmp_path / "report")
    assert "Camera poses" in html and "is not an image that can be read" not in html or "cameras.png" in html
