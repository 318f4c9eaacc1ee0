"""Reading of evaluations and curves, including broken files."""

import json
import shutil
from pathlib import Path

import pytest

from bitymi_ns.measure.report.read import collect, read_jsonl
from bitymi_ns.measure.report.records import Records, ReportError, link, over_seeds
from tests.measure.report.conftest import cell, figures, make, write_lines


def test_nan_and_infinity_tokens_are_missing_values(tmp_path: Path):
    path = tmp_path / "eval.json"
    path.write_text('{"results": {"psnr": 20.5, "psnr_std": NaN, "lpips": Infinity, "note": "x", "flag": true}}')
    (row,) = collect([path], tmp_path / "report").evaluations
    assert row.results == {"psnr": 20.5}
    assert row.scene == tmp_path.name and row.method == "unnamed method"


@pytest.mark.parametrize("method", ["bitymi", "half-baked", "bundle"])
def test_a_bundle_states_its_bytes_and_a_run_has_none(method: str) -> None:
    rows = [make(method=method, psnr=20.0, **results) for results in ({}, {"atlas_bytes": 0}, {"bundle_bytes": 9})]
    assert [row.baked for row in rows] == [False, False, True]


def test_a_bundle_is_compared_with_the_trained_scene_of_its_folder_when_there_are_several():
    rows = [make(source=f"run{i}/trained.json", psnr=20.0 + i) for i in (1, 2)]
    for scene, folder in (("fox", "run2"), ("fox", "run3"), ("lego", "run1")):
        rows.append(make(scene=scene, source=f"{folder}/baked.json", bundle_bytes=1, psnr=21.9))
    link(records := Records(rows))
    deltas = [row.results.get("psnr_delta") for row in records.evaluations]
    assert deltas == [None, None, pytest.approx(-0.1), None, None]


def test_curve_keeps_the_last_line_of_a_repeated_step_and_leaves_out_a_cut_last_line(tmp_path: Path):
    path = tmp_path / "curve.jsonl"
    lines = [{"step": 0, "psnr": 9.0}, {"step": 100, "psnr": float("nan")}, {"step": 200}, {"step": 100, "psnr": 15.0}]
    path.write_text("\n".join(map(json.dumps, lines)) + '\n\n{"step": 300, "ps')
    read = read_jsonl(path)
    (curve,) = read.curves
    assert not read.evaluations
    assert curve.series("step", "psnr") == ([0.0, 100.0], [9.0, 15.0])
    assert curve.last("step") == 200 and curve.last("seconds") is None
    assert len(read.notes) == 1 and "cut off" in read.notes[0]


def test_broken_line_inside_a_curve_is_an_error_with_its_number(tmp_path: Path):
    path = tmp_path / "curve.jsonl"
    path.write_text('{"step": 0}\n{"step": 1,,}\n{"step": 2}\n')
    with pytest.raises(ReportError, match=r"curve\.jsonl, line 2, cannot be read"):
        read_jsonl(path)


def test_lines_with_results_are_evaluations(tmp_path: Path):
    path = tmp_path / "cells.jsonl"
    path.write_text('{"step": 5, "experiment_name": "fox", "method_name": "m", "results": {"psnr": 20}}\n')
    read = read_jsonl(path)
    assert read.evaluations[0].results == {"psnr": 20.0} and not read.curves


def test_namesakes_get_different_labels(eval_json, tmp_path: Path):
    inputs = [eval_json("seed0/eval.json", psnr=20.0), eval_json("seed1/eval.json", psnr=20.1)]
    labels = [e.label for e in collect(inputs, tmp_path / "report").evaluations]
    assert sorted(labels) == ["bitymi (seed0/eval)", "bitymi (seed1/eval)"]


def test_search_reads_a_file_once_and_leaves_out_hidden_folders_and_the_report(eval_json, tmp_path: Path):
    for name in (".hidden/e.json", "report/e.json"):
        eval_json(name, psnr=1.0)
    path = eval_json("kept/e.json", psnr=2.0)
    (tmp_path / "kept" / "again").symlink_to(tmp_path / "kept")
    records = collect([path, path, tmp_path], tmp_path / "report")
    assert [e.results["psnr"] for e in records.evaluations] == [2.0]


# cells of a benchmark


def test_a_work_folder_is_read_by_its_cells_alone(work: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(work, tmp_path / "work"))
    (copy / "evals" / "trained.json").write_text('{"results": {"psnr": 1.0}}')
    records = collect([tmp_path], tmp_path / "report")
    assert [e.results["psnr"] for e in records.evaluations] == pytest.approx([25.0, 24.9, 25.2, 25.1])
    assert [e.label for e in records.evaluations[:2]] == ["bitymi, seed 0", "bitymi, bc7, seed 0"]
    assert records.evaluations[1].results["bundle_bytes"] == 3e6
    assert records.evaluations[3].results["train_seconds"] == 11.0
    assert [c.label for c in records.curves] == ["bitymi, seed 0", "bitymi, seed 1"]
    assert len(records.images) == 1 and records.machines == ["Abacus, 10 beads"]
    trained, baked = over_seeds(records.evaluations)
    assert trained.label == "bitymi (2 seeds)" and trained.results["psnr"] == pytest.approx(25.1)
    assert baked.results["psnr_seeds"] == pytest.approx(0.1414, abs=1e-3)
    assert baked.label == "bitymi, bc7 (2 seeds)"
    only = over_seeds([row for row in records.evaluations if not row.baked or row.label.endswith("seed 0")])
    assert [row.baked for row in only] == [False, True]
    assert only[1].results["psnr_delta"] == pytest.approx(-0.1)  # from its own seed


def test_of_equal_keys_the_last_line_counts(tmp_path: Path) -> None:
    path = write_lines(tmp_path / "cells.jsonl", [cell("eval", figures(p, 9.0), row=f"row {p}") for p in (20, 21)])
    (row,) = collect([path], tmp_path / "report").evaluations
    assert row.results["psnr"] == 21 and row.method == "row 21"


def test_runs_that_differ_in_length_are_told_apart(tmp_path: Path) -> None:
    cells = [cell("eval", figures(20, 9.0), steps=s) for s in (100, 1200, None)]
    path = write_lines(tmp_path / "cells.jsonl", cells)
    labels = [e.method for e in collect([path], tmp_path / "report").evaluations]
    assert labels == ["bitymi, 100 steps", "bitymi, 1,200 steps", "bitymi, own length"]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('{"key": {"cell": "eval"}, "value": {}}', "the entry 'scene' is missing"),
        ('{"key": {"cell": "eval", "scene": "a", "row": "b"}, "value": {}}', "the entry 'results' is missing"),
        (
            '{"key": {"cell": "eval", "scene": 3, "row": ""}, "made": "x", "value": {"results": {"psnr": "bad"}}}',
            "the entry 'psnr' is missing",
        ),
    ],
)
def test_malformed_lines_are_named(tmp_path: Path, line: str, reason: str) -> None:
    good = json.dumps(cell("eval", figures(20.0, 5.0)))
    (tmp_path / "cells.jsonl").write_text(f"{good}\n{line}\n{good}\n")
    with pytest.raises(ReportError, match=reason):
        collect([tmp_path / "cells.jsonl"], tmp_path / "report")
