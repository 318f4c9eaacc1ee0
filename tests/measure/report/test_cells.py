"""Cells, knobs, pictures and the paper's tables in a report."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from bitymi_ns.measure.report import ReportError, build
from bitymi_ns.measure.report.collect import collect
from bitymi_ns.measure.report.paper import paper_tables, published
from bitymi_ns.measure.report.pareto import front
from bitymi_ns.measure.report.records import over_seeds, psnr_delta

VOID = {"meta", "img", "source", "br"}


class Checker(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: dict[str, int] = {}

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.seen[tag] = self.seen.get(tag, 0) + 1
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes something else"


def check_html(text: str) -> Checker:
    assert text.startswith("<!DOCTYPE html>")
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert not checker.open
    return checker


def cell(kind: str, value: dict[str, Any], bundle: str = "", **key: Any) -> dict[str, Any]:
    settings = {
        "cell": kind, "suite": "local", "row": "bitymi", "scene": "fox", "data": "/data/fox", "parser": [],
        "method": "bitymi", "options": [], "steps": 100, "seed": 0, **key,
    }  # fmt: skip
    if bundle:
        settings |= {"bundle": bundle, "export": ["--format", bundle]}
    return {"key": settings, "value": value, "made": {"machine": "Abacus, 10 beads", "seconds": 3.0}}


def results(psnr: float, ms: float, **more: float) -> dict[str, Any]:
    return {"results": {"psnr": psnr, "ssim": 0.8, "flip": 0.1, "surfels": 5000.0, "render_ms": ms, **more}}


def knob(value: Any, exact: bool = False, mean: float = 0.5, **more: Any) -> dict[str, Any]:
    return {
        "knob": "format", "value": value, "renderer": "baked", "exact": exact, "default": value == "bc7",
        "max_steps": 0.0 if exact else 4 * mean, "mean_steps": 0.0 if exact else mean, "psnr_exact": 60.0,
        "psnr": 25.0, "ms": 4.0, "cpu_ms": 8.0, "bytes": 1_000_000, "against": "texels; exact: floats", **more,
    }  # fmt: skip


def write(path: Path, cells: list[dict[str, Any]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(c) + "\n" for c in cells))
    return path


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """A work folder: two seeds of one row, baked, with pictures and knobs."""
    folder = tmp_path / "work"
    cells = []
    for seed, shift in ((0, 0.0), (1, 0.2)):
        curve = folder / "runs" / str(seed) / "training_curve.jsonl"
        write(curve, [{"step": s, "seconds": s / 10, "cpu_seconds": s / 5, "psnr": 20 + s / 50} for s in (50, 100)])
        train = {"steps": 100, "seconds": 10.0 + seed, "cpu_seconds": 20.0, "surfels": 5000}
        cells.append(cell("train", {**train, "curve": f"runs/{seed}/training_curve.jsonl"}, seed=seed))
        cells.append(cell("eval", results(25.0 + shift, 30.0), seed=seed))
        cells.append(cell("export", {"bytes": 3_000_000, "format": "bc7"}, "bc7", seed=seed))
        cells.append(cell("eval", results(24.9 + shift, 10.0, atlas_bytes=2e6), "bc7", seed=seed))
    pictures = folder / "pictures"
    pictures.mkdir()
    Image.new("RGB", (16, 12), (200, 10, 10)).save(pictures / "v.png")
    view = {"view": 4, "rank": 1, "of": 7, "metrics": {"psnr": 21.5, "flip": 0.2}, "files": {"photo": "v.png"}}
    listed = {"bitymi_pictures": 1, "scene": "fox", "method": "bitymi", "captions": {"photo": "the photo"}}
    (pictures / "pictures.json").write_text(json.dumps({**listed, "views": [view]}))
    cells.append(cell("pictures", {"folder": "pictures", "views": 1}))
    cells.append(cell("knobs", {"points": [knob("float32", True), knob("fp16", mean=0.1), knob("bc7")]}))
    write(folder / "cells.jsonl", cells)
    return folder


def test_a_work_folder_is_read_by_its_cells_alone(work: Path, tmp_path: Path) -> None:
    (work / "evals").mkdir()
    (work / "evals" / "trained.json").write_text('{"results": {"psnr": 1.0}}')
    records = collect([tmp_path], tmp_path / "report")
    assert [e.results["psnr"] for e in records.evaluations] == pytest.approx([25.0, 24.9, 25.2, 25.1])
    assert [e.label for e in records.evaluations[:2]] == ["bitymi, seed 0", "bitymi, bc7, seed 0"]
    assert records.evaluations[1].results["bundle_bytes"] == 3e6
    assert records.evaluations[3].results["train_seconds"] == 11.0
    assert [c.label for c in records.curves] == ["bitymi, seed 0", "bitymi, seed 1"]
    assert len(records.knobs) == 3 and len(records.worst) == 1 and records.machines == ["Abacus, 10 beads"]


def test_means_over_seeds_with_their_spread(work: Path, tmp_path: Path) -> None:
    trained, baked = over_seeds(collect([work], tmp_path / "report").evaluations)
    assert trained.label == "bitymi (2 seeds)" and trained.results["psnr"] == pytest.approx(25.1)
    assert baked.results["psnr_seeds"] == pytest.approx(0.1414, abs=1e-3) and baked.seeds == 2
    assert baked.label == "bitymi, bc7 (2 seeds)"


def test_a_bundle_of_one_seed_is_compared_with_that_seed(work: Path, tmp_path: Path) -> None:
    rows = collect([work], tmp_path / "report").evaluations
    only = [row for row in rows if not row.baked or row.seed == 0]
    merged = over_seeds(only)
    assert len(only) == 3 and [row.baked for row in merged] == [False, True] and merged[0].seeds == 2
    before, after = (row.results["psnr"] for row in only if row.seed == 0)
    assert psnr_delta(merged[1], merged) == pytest.approx(after - before)


def test_the_page_has_everything_and_is_well_formed(work: Path, tmp_path: Path) -> None:
    html = build([work], tmp_path / "report", title="<all>").read_text("utf8")
    checker = check_html(html)
    assert checker.seen["table"] >= 3 and checker.seen["h2"] >= 6
    for text in (
        "bitymi (2 seeds)", "−0.100", "Error against training time", "Error against rendering time",
        "Quality knobs", "float32 (exact)", "bc7 (default)", "Worst views", "the photo",
        "view 4, worst of 7: 21.50 dB, 0.200 FLIP", "Abacus, 10 beads", "Pareto front",
    ):  # fmt: skip
        assert text in html
    assert "tables</h2>" not in html  # none of the paper's data sets
    markdown = (tmp_path / "report" / "report.md").read_text("utf8")
    assert "knob_format.png" in markdown and "flip_render_ms.png" in markdown
    assert (tmp_path / "report" / "ssim_train_seconds.png").is_file()


def test_of_equal_keys_the_last_line_counts(tmp_path: Path) -> None:
    path = write(tmp_path / "cells.jsonl", [cell("eval", results(p, 9.0), row=f"row {p:.0f}") for p in (20, 21)])
    (row,) = collect([path], tmp_path / "report").evaluations
    assert row.results["psnr"] == 21 and row.method == "row 21"


def test_runs_that_differ_in_length_are_told_apart(tmp_path: Path) -> None:
    path = write(tmp_path / "cells.jsonl", [cell("eval", results(20, 9.0), steps=s) for s in (100, 1200, None)])
    labels = [e.method for e in collect([path], tmp_path / "report").evaluations]
    assert labels == ["bitymi, 100 steps", "bitymi, 1,200 steps", "bitymi, own length"]


def test_cells_of_an_earlier_form(tmp_path: Path) -> None:
    key = {"cell": "eval", "format": "bc7", "data": "/data/fox", "method": "bitymi", "steps": 9, "extra": ["--a", "1"]}
    (tmp_path / "cells.jsonl").write_text(json.dumps({"key": key, "value": {"psnr": 20.0, "commit": "x"}}) + "\n")
    (row,) = collect([tmp_path], tmp_path / "report").evaluations
    assert (row.scene, row.label, row.baked) == ("fox", "bitymi --a 1, bc7", True)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("{}", r"line 2, is not a cell of a benchmark"),
        ('{"key": {"cell": "eval"}, "value": {}}', r"line 2: the eval cell lacks .*psnr"),
        ('{"key": {"cell": "knobs"}, "value": {}}', r"line 2: the knobs cell lacks 'points'"),
        ('{"key": {"cell": "pictures"}, "value": {}}', r"line 2: the pictures cell lacks 'folder'"),
        ("nonsense", r"line 2, is not valid JSON"),
    ],
)
def test_malformed_lines_are_named(tmp_path: Path, line: str, reason: str) -> None:
    good = json.dumps(cell("eval", results(20.0, 5.0)))
    (tmp_path / "cells.jsonl").write_text(f"{good}\n{line}\n{good}\n")
    with pytest.raises(ReportError, match=reason):
        build([tmp_path / "cells.jsonl"], tmp_path / "report")


def test_a_cut_off_last_line_is_noted(work: Path, tmp_path: Path) -> None:
    path = work / "cells.jsonl"
    path.write_text(path.read_text()[:-30])
    html = build([work], tmp_path / "report").read_text("utf8")
    assert "the last line is cut off" in html and "Quality knobs" not in html


@pytest.mark.parametrize("change", [{"views": [{}]}, {"views": 3}, {"captions": None}])
def test_malformed_pictures_are_named(work: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    path = work / "pictures" / "pictures.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ReportError, match=r"pictures\.json does not list its views"):
        build([path], tmp_path / "report")


def test_a_picture_that_is_gone_is_noted(work: Path, tmp_path: Path) -> None:
    (work / "pictures" / "v.png").unlink()
    assert "v.png is not an image" in build([work], tmp_path / "report").read_text("utf8")


# Pareto fronts


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


def test_no_point_beats_one_of_the_front() -> None:
    points = [((i * 37) % 101, (i * 53) % 97) for i in range(60)]
    for up in (True, False):
        for cost, quality in front(points, up):
            better = [q > quality if up else q < quality for c, q in points if c <= cost]
            assert not any(better)


# the paper's tables


def suite_cells() -> list[dict[str, Any]]:
    cells = []
    for scene in ("train", "truck"):
        for method, psnr in (("bitymi", 23.0), ("bitymi-quality", 24.0)):
            key = {"suite": "tanksandtemples", "scene": scene, "row": method, "method": method, "data": f"/d/{scene}"}
            cells.append(cell("eval", results(psnr, 40.0), **key))
            cells.append(cell("eval", results(psnr - 0.5, 10.0, atlas_bytes=2e6), "bc7", **key))
    return cells


def test_published_figures_are_the_papers() -> None:
    data = published()
    assert [len(data[k]) for k in ("quantization", "comparison", "falloff", "view_colors")] == [3, 10, 3, 3]
    scenes = data["per_scene"]
    assert list(scenes["trained"]) == list(scenes["baked"]) and len(scenes["baked"]) == 13
    for stage in scenes.values():
        for pair in stage.values():
            assert [len(side) for side in pair] == [5, 5]
    # a mean that the paper prints is that of the scenes that it prints
    rooms = [v[0][0] for k, v in scenes["baked"].items() if k not in ("train", "truck") and "mean" not in k]
    assert sum(rooms) / 9 == pytest.approx(scenes["baked"]["mip-360 mean"][0][0], abs=0.01)


def test_the_papers_tables_stand_beside_ours(tmp_path: Path) -> None:
    path = write(tmp_path / "cells.jsonl", suite_cells())
    html = build([path], tmp_path / "report").read_text("utf8")
    check_html(html)
    for text in ("The paper’s tables", "Published, on other hardware", "NVIDIA RTX 4090", "Nexels", "Hybrid Latents"):
        assert text in html
    records = collect([path], tmp_path / "report")
    tables = paper_tables(records, over_seeds(records.evaluations))
    assert [t.title[:8] for t in tables] == [f"Table {i}:" for i in range(1, 7)]
    for table in tables:
        assert all(row.section or len(row.cells) == len(table.header) for row in table.rows)
    comparison = {row.cells[0]: row.cells for row in tables[1].rows}
    assert comparison["bitymi"][1:6] == ("22.50", "0.800", "–", "5,000", "100")
    assert comparison["3DGS"][1:6] == ("23.80", "0.853", "0.169", "1.5M", "154")
    falloff = {row.cells[0]: row.cells for row in tables[2].rows}
    assert falloff["train: λ = 0.005"][2] == "22.50" and falloff["truck: λ = 0"][2] == "23.50"
    means = [row.cells for row in tables[5].rows if row.cells[0] == "Tanks and Temples mean"]
    assert [row[1] for row in means] == ["23.00", "22.50"] and [row[6] for row in means] == ["24.00", "23.50"]
    formats = {row.cells[0]: row.cells for row in tables[0].rows}
    assert formats["bc7"] == ("bc7", "1", "2.00", "−0.500")


def test_variants_of_the_bake_are_none_of_the_papers_rows(tmp_path: Path) -> None:
    plain = suite_cells()
    variants = []
    for c in plain:
        if "bundle" in c["key"]:
            key = {**c["key"], "bundle": "paper-rule", "export": ["--format", "bc7", "--exact", "True"]}
            value = {**c["value"], **results(9.0, 99.0, atlas_bytes=9e7)}
            variants.append({**c, "key": key, "value": value})
    pages = []
    for name, cells in (("plain", plain), ("all", [*variants, *plain])):
        records = collect([write(tmp_path / f"{name}.jsonl", cells)], tmp_path / "report")
        pages.append(paper_tables(records, over_seeds(records.evaluations)))
    assert len(variants) == 4 and pages[0] == pages[1]


def test_part_of_a_suite_is_no_mean_of_it(tmp_path: Path) -> None:
    cells = [c for c in suite_cells() if c["key"]["scene"] == "truck"]
    records = collect([write(tmp_path / "cells.jsonl", cells)], tmp_path / "report")
    tables = paper_tables(records, records.evaluations)
    assert "1 of 2 scenes of Tanks and Temples" in tables[1].note
    assert not any(row.cells[0] == "Tanks and Temples mean" for row in tables[5].rows)


def test_own_captures_get_the_tables_on_request_only(work: Path, tmp_path: Path) -> None:
    assert "FastGS" not in build([work], tmp_path / "a").read_text("utf8")
    html = build([work], tmp_path / "b", published=True).read_text("utf8")
    assert "FastGS" in html and "no run on these data sets" in html and "fox: λ = 0.005" in html
