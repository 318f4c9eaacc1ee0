"""The report as a whole: what it writes, and how it fails."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import matplotlib
import pytest
from PIL import Image

from bitymi_ns.measure.report import ReportError, build

PLOTS = [f"{metric}_{cost}" for metric in ("psnr", "ssim", "flip") for cost in ("train_seconds", "render_ms", "bytes")]
PLOTS += ["psnr_seconds", "psnr_cpu_seconds", "surfels_steps"]


def pictures(page: str) -> list[Image.Image]:
    """Every image embedded in a page, decoded."""
    found = re.findall(r"data:image/(?:png|jpeg);base64,([A-Za-z0-9+/=]+)", page)
    images = [Image.open(io.BytesIO(base64.b64decode(data))) for data in found]
    for image in images:
        image.load()
    return images


def test_full_report(results: Path, tmp_path: Path):
    out = tmp_path / "report"
    page = build([results], out, title="Two <scenes>")
    assert page == out / "index.html"
    assert {p.name for p in out.iterdir()} == {"index.html", "report.md", *(f"{name}.png" for name in PLOTS)}
    html, markdown = page.read_text("utf8"), (out / "report.md").read_text("utf8")
    assert "Two &lt;scenes&gt;" in html and not re.search(r"(?:src|srcset|href)=\"(?!data:)", html)
    # of two scenes three views: photograph, two renders, two errors
    assert len(pictures(html)) == 2 * len(PLOTS) + 2 * 3 * 5
    assert html.index("Worst view of 7") < html.index("Median view of 7") < html.index("Best view of 7")
    assert html.index("Best view of 7") < html.index("Quality and speed")
    for text in ("27.41", "−0.031", "Trained scene", "Mean of 2 scenes", "18,942"):
        assert text in html and text in markdown
    assert "LPIPS" not in html and "nan" not in markdown.lower()
    for name in PLOTS:
        with Image.open(out / f"{name}.png") as image:
            assert image.width > 600
            assert image.convert("L").getextrema() != (255, 255)
        assert f"({name}.png)" in markdown
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".report")]


def test_plots_are_not_drawn_as_the_current_folder_says(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)
    assert pictures(build([results / "evals" / "fox"], tmp_path / "report").read_text("utf8"))


def test_same_input_gives_the_same_bytes(results: Path, tmp_path: Path):
    first, second = (build([results / "evals" / "fox"], tmp_path / name) for name in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()


def test_one_evaluation_is_enough(eval_json, tmp_path: Path):
    page = build([eval_json(psnr=20.0, render_ms=12.0)], tmp_path / "report")
    assert "20.00" in page.read_text("utf8")


@pytest.mark.parametrize(("count", "drawn"), [(2, set()), (3, {"psnr_render_ms.png"})])
def test_plots_of_one_or_two_points_are_left_out(eval_json, tmp_path: Path, count: int, drawn: set[str]):
    rows = [eval_json(f"{i}.json", method=f"m{i}", psnr=20.0 + i, render_ms=12.0 + i) for i in range(count)]
    curve = tmp_path / "curve.jsonl"
    curve.write_text("".join(json.dumps({"step": i, "seconds": i, "psnr": 20.0}) + "\n" for i in range(count)))
    build([*rows, curve], tmp_path / "report")
    assert {p.name for p in (tmp_path / "report").glob("*.png")} == drawn | ({"psnr_seconds.png"} if drawn else set())


def test_curve_alone_without_psnr(tmp_path: Path):
    curve = tmp_path / "curve.jsonl"
    curve.write_text("".join(json.dumps({"step": i, "surfels": 100 + i, "psnr": None}) + "\n" for i in range(5)))
    build([curve], tmp_path / "report")
    assert {p.name for p in (tmp_path / "report").glob("*.png")} == {"surfels_steps.png"}


def test_evaluation_whose_numbers_are_all_nan(tmp_path: Path):
    path = tmp_path / "eval.json"
    path.write_text('{"experiment_name": "fox", "method_name": "bitymi", "results": {"psnr": NaN, "render_ms": 0}}')
    assert build([path], tmp_path / "report").exists()


def test_a_later_report_replaces_an_earlier_one_and_nothing_else(results: Path, eval_json, tmp_path: Path):
    out = tmp_path / "report"
    build([results], out)
    (out / "mine.txt").write_text("keep")
    build([eval_json(psnr=20.0)], out)
    assert {p.name for p in out.iterdir()} == {"index.html", "report.md", "mine.txt"}


def test_report_inside_the_folder_that_it_reads(results: Path):
    for _ in range(2):
        build([results], results)
    assert "16 evaluations" in (results / "index.html").read_text("utf8")


@pytest.mark.parametrize("name", ["report.md", "psnr_bytes.png"])
def test_files_of_a_reports_names_are_not_replaced(results: Path, tmp_path: Path, name: str):
    out = tmp_path / "report"
    out.mkdir()
    (out / name).write_text("mine")
    with pytest.raises(ReportError, match=f"holds {name}, which would be replaced"):
        build([results / "evals" / "fox"], out)
    assert (out / name).read_text() == "mine"
    (out / name).unlink()
    build([results / "evals" / "fox"], out)
    (out / "index.html").unlink()  # as a killed report leaves it
    build([results / "evals" / "fox"], out)


def test_broken_files_of_a_folder_are_noted(results: Path, tmp_path: Path):
    (results / "evals" / "fox" / "broken.json").write_text('{"results": {"psnr": 2')
    (results / "renders" / "fox" / "trained" / "eval_img_0000.png").write_bytes(b"\x89PNG\r\n\x1a\nrubbish")
    html = build([results], tmp_path / "report").read_text("utf8")
    assert "broken.json is not valid JSON" in html and "eval_img_0000.png is not an image" in html


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("missing.json", None, "does not exist"),
        ("broken.json", b'{"results": ', r"broken\.json is not valid JSON: .* at line 1, column"),
        ("empty.json", b"", "is not valid JSON: it is empty"),
        ("deep.json", b"[" * 100_000, "is not valid JSON"),
        ("other.json", b'{"frames": []}', "holds neither an evaluation"),
        ("list.json", b"[1, 2]", "holds neither an evaluation"),
        ("binary.json", b"\xff\xfe\x00", "is not a text file"),
        ("empty.jsonl", b"", "holds neither"),
        ("text.jsonl", b"hello\n", r"line 1, is not valid JSON"),
    ],
)
def test_named_file_that_is_no_use(tmp_path: Path, name: str, content: bytes | None, reason: str):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ReportError, match=reason) as error:
        build([path], tmp_path / "report")
    assert name in str(error.value)
    assert not (tmp_path / "report").exists()


def test_nothing_usable(tmp_path: Path):
    (tmp_path / "in").mkdir()
    with pytest.raises(ReportError, match="nothing to report in .*ns-eval"):
        build([tmp_path / "in"], tmp_path / "report")
    with pytest.raises(ReportError, match="nothing to report"):
        build([], tmp_path / "report")


def test_foreign_page_is_not_replaced(eval_json, tmp_path: Path):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("<html>mine</html>")
    with pytest.raises(ReportError, match="will not be replaced"):
        build([eval_json(psnr=20.0)], tmp_path / "site")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ReportError, match="is a file"):
        build([eval_json(psnr=20.0)], tmp_path / "file")


def test_full_disk_leaves_the_older_report(eval_json, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    out = tmp_path / "report"
    older = build([eval_json(psnr=20.0, render_ms=1.0)], out).read_bytes()
    write = Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        if self.name == "index.html":
            write(self, data[:100])
            raise OSError(28, "No space left on device")
        return write(self, data)

    newer = eval_json("newer.json", psnr=30.0)
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ReportError, match="the disk is full"):
        build([newer], out)
    assert (out / "index.html").read_bytes() == older
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".report")]


def test_other_images_keep_their_names_and_sizes(eval_json, tmp_path: Path):
    folder = tmp_path / "renders"
    folder.mkdir()
    noise = Image.effect_noise((1600, 900), 80).convert("RGB")
    for i in range(5):
        noise.save(folder / f"eval_depth_{i:04d}.png")
    Image.new("RGBA", (32, 16), (255, 0, 0, 128)).save(folder / "preview.png")
    Image.new("RGB", (8, 8)).save(folder / "photograph.png")
    html = build([eval_json(psnr=20.0), folder], tmp_path / "report").read_text("utf8")
    sizes = [image.size for image in pictures(html)]
    assert sizes == [(32, 16)] + [(1200, 675)] * 4
    assert "view 4, depth" in html and len(html) < 8_000_000
