"""The report as a whole: contents and errors."""

import base64
import io
import json
import re
from pathlib import Path

import pytest
from PIL import Image

from bitymi_ns.measure.report.page import build
from bitymi_ns.measure.report.records import ReportError
from bitymi_ns.safe_reading import open_regular
from tests.changes import SPOILT
from tests.measure.report.conftest import cell, figures, write_lines

PLOTS = 12  # of three metrics against three costs, and of training curves


def check_nesting(page: str) -> None:
    """Check that elements are closed in order."""
    assert page.startswith("<!DOCTYPE html>")
    opened = []
    for end, tag in re.findall(r"<(/?)(\w+)", page):
        if not end and tag not in ("meta", "img", "br"):
            opened.append(tag)
        assert not end or opened.pop() == tag, f"</{tag}> closes something else"
    assert not opened


def pictures(page: str) -> list[Image.Image]:
    found = re.findall(r"data:image/(?:png|jpeg);base64,([A-Za-z0-9+/=]+)", page)
    images = [Image.open(io.BytesIO(base64.b64decode(data))) for data in found]
    for image in images:
        image.load()
    return images


def test_the_page_is_whole_and_needs_no_other_file(page: str, results: Path) -> None:
    check_nesting(page)
    assert "Two &lt;scenes&gt;" in page and not re.search(r"(?:src|srcset|href)=\"(?!data:)", page)
    assert "16 evaluations, 4 training runs, 2 scenes." in page
    for text in ("27.41", "−0.031", "Trained scene", "Mean of 2 scenes", "18,942", "Mean of 2 scenes, training"):
        assert text in page
    assert "LPIPS" not in re.sub("<p.*", "", page) and ">nan<" not in page.lower()
    assert [path.name for path in results.with_name("report").iterdir()] == ["index.html"]
    images = pictures(page)
    # two scenes with three views each: photograph, two renders, two errors
    assert len(images) == PLOTS + 2 * 3 * 5
    plots = [image for image in images if image.width > 600]
    assert len(plots) == PLOTS and all(image.convert("L").getextrema() != (255, 255) for image in plots)


def test_broken_files_of_a_folder_are_noted(page: str) -> None:
    assert "broken.json cannot be read" in page and "eval_img_0099.png is not an image" in page


def test_a_benchmark(work: Path, tmp_path: Path) -> None:
    page = build([work], tmp_path / "report").read_text("utf8")
    check_nesting(page)
    for text in ("bitymi (2 seeds)", "−0.100", "Worst view of 1: number 0", "Abacus, 10 beads"):
        assert text in page


@pytest.mark.parametrize(("count", "drawn"), [(1, 0), (2, 0), (3, 2)])
def test_plots_of_one_or_two_points_are_left_out(eval_json, tmp_path: Path, count: int, drawn: int) -> None:
    rows = [eval_json(f"{i}.json", method=f"m{i}", psnr=20.0 + i, render_ms=12.0 + i) for i in range(count)]
    curve = tmp_path / "curve.jsonl"
    curve.write_text("".join(json.dumps({"step": i, "seconds": i, "psnr": 20.0}) + "\n" for i in range(count)))
    page = build([*rows, curve], tmp_path / "report").read_text("utf8")
    assert len(pictures(page)) == drawn and "20.00" in page


def test_a_later_report_replaces_an_earlier_one_and_nothing_else(eval_json, tmp_path: Path) -> None:
    for name, psnr in (("a.json", 20.0), ("b.json", 21.0)):
        eval_json(name, psnr=psnr)
        (tmp_path / "mine.txt").write_text("keep")
        page = build([tmp_path], tmp_path)  # inside the folder that it reads
    assert "2 evaluations" in page.read_text("utf8") and (tmp_path / "mine.txt").is_file()


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("missing.json", None, "does not exist"),
        ("broken.json", b'{"results": ', r"broken\.json cannot be read: .* line 1 column"),
        ("empty.json", b"", "cannot be read"),
        ("deep.json", b"[" * 100_000, "cannot be read"),
        ("list.json", b"[1, 2]", "holds neither an evaluation"),
        ("binary.json", b"\xff\xfe\x00", "it is no text in UTF-16"),
        ("empty.jsonl", b"", "holds neither"),
    ],
)
def test_named_file_that_is_no_use(tmp_path: Path, name: str, content: bytes | None, reason: str) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ReportError, match=reason) as error:
        build([path], tmp_path / "report")
    assert name in str(error.value)
    assert not (tmp_path / "report").exists()


def test_nothing_usable(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for inputs in ([tmp_path / "in"], []):
        with pytest.raises(ReportError, match="nothing to report in .*ns-eval"):
            build(inputs, tmp_path / "report")
    path, curve = tmp_path / "eval.json", tmp_path / "curve.jsonl"
    path.write_text('{"experiment_name": "fox", "method_name": "bitymi", "results": {"psnr": NaN, "render_ms": 0}}')
    curve.write_text('{"step": 1, "psnr": null}\n')
    assert "1 evaluation, 1 training run" in build([path, curve], tmp_path / "report").read_text("utf8")


def test_foreign_page_is_not_replaced(eval_json, tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("<html>mine</html>")
    with pytest.raises(ReportError, match="will not be replaced"):
        build([eval_json(psnr=20.0)], tmp_path / "site")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ReportError, match="file is not a folder: choose another path"):
        build([eval_json(psnr=20.0)], tmp_path / "file")


@pytest.mark.parametrize("kind", SPOILT)
def test_reports_of_what_is_no_file(tmp_path: Path, kind: str) -> None:
    (tmp_path / "in").mkdir()
    SPOILT[kind](tmp_path / "in/eval.json")
    SPOILT[kind](tmp_path / "in/eval_img_0001.png")
    for given in (tmp_path / "in", tmp_path / "in/eval.json"):
        with pytest.raises(ReportError, match="eval.json|nothing to report"):
            build([given], tmp_path / "report")


def test_names_in_a_report_that_no_file_can_have(tmp_path: Path) -> None:
    """Found by scripts/fuzz.py."""
    named = [cell("train", {"curve": "a" * 300}), cell("eval", figures(25.0, 30.0) | {"pictures": "a" * 300})]
    cells = write_lines(tmp_path / "cells.jsonl", named)
    assert build([cells], tmp_path / "cells").is_file()
    with pytest.raises(OSError, match="no file can have this name"):
        open_regular(tmp_path / "a\0")
