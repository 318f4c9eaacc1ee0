"""Exports of runs with a field: baked, polished, fine-tuned, compared with the field."""

import json
from pathlib import Path

import pytest

from bitymi_ns.bake import TuneOptions
from bitymi_ns.bundle import check_files
from bitymi_ns.cli import main
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.trained import check_run
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.e2e.exports import TOLERANCE, evaluate, run_export
from tests.typed import Printed


def test_it_is_polished_and_tuned(field_run: Run, tmp_path: Path, capsys: Printed) -> None:
    run_export(field_run, tmp_path / "b", tolerance=TOLERANCE, polish_steps=30, finetune_steps=8)
    statistics = json.loads((tmp_path / "b" / "bundle.json").read_text())["statistics"]
    polished, tuned = statistics["polish"], statistics["finetune"]
    assert tuned["steps"] <= 8 + TuneOptions.coded_steps and tuned["views"] + tuned["held_in_views"] == 10
    assert tuned["psnr_held_in"]["after"] == max(psnr for _, psnr in tuned["curve"]) and tuned["cpu_seconds"] > 0
    assert polished["steps"] <= 30 and polished["views"] + polished["held_in_views"] == 10
    assert polished["psnr_held_in"]["after"] == max(psnr for _, psnr in polished["curve"])
    assert tuned["psnr_held_in"]["before"] == pytest.approx(polished["psnr_held_in"]["after"], abs=0.1)
    texels = statistics["texels"]
    assert 0 < texels["kept"] <= texels["polished"] <= texels["within_visible_part"]
    stored = evaluate(tmp_path / "b" / "config.yml", tmp_path / "polished.json")["psnr"]
    assert stored == pytest.approx(tuned["psnr_held_out"]["after"], abs=0.1)
    out = " ".join(capsys.readouterr().out.split())
    assert "polishing" in out and "Polish" in out and "Fine-tuning" in out and "tuning texels" in out
    assert "30 steps for 10 training photographs, 3.0 for each: more may gain" in out
    assert "The export will take about" in out and "GB of memory for 10 training photographs of 48 x 36" in out
    bundle, checks = check_files(tmp_path / "b")
    assert bundle is not None and all(check.ok for check in checks)
    found = {check.name: check for check in check_run(bundle, field_run.get_base_dir() / "config.yml", views=1)}
    assert all(check.ok for check in found.values())
    assert "the surfels learned after the bake" in found["error of the view colours"].detail


def test_exact_keeps_everything_and_others_say_less(
    field_run: Run, field_bundle: Path, tmp_path: Path, capsys: Printed
) -> None:
    run_export(field_run, tmp_path / "exact", exact=True)
    printed = capsys.readouterr().out
    exact, default = (
        json.loads((f / "bundle.json").read_text())["statistics"] for f in (tmp_path / "exact", field_bundle)
    )
    assert exact["texels"]["kept"] == exact["texels"]["nyquist"] == default["texels"]["nyquist"]
    assert 0 < default["texels"]["kept"] < 0.8 * exact["texels"]["kept"]
    assert exact["surfels"]["left_out"].get("unseen", 0) == 0 and exact["options"]["tolerance"] == 0
    assert "Atlas bytes" in printed and "all of it is kept" in printed
    assert "view_color" not in exact and default["view_color"]["tolerance"] == TOLERANCE
    assert default["view_color"]["sites"]["after"] < default["view_color"]["sites"]["before"]
    certificate = default["certificate"]
    assert certificate["tolerance"] == TOLERANCE and 0 < certificate["worst"] < 1
    assert certificate["within"] + certificate["beyond"] == default["surfels"]["kept"]


def test_verify_compares_with_the_run(field_run: Run, field_bundle: Path, capsys: Printed) -> None:
    run = field_run.get_base_dir()
    assert main(["verify", str(field_bundle), "--run", str(run / "config.yml")]) == 0
    assert "PSNR against the trained scene" in capsys.readouterr().out
    bundle, _ = check_files(field_bundle)
    assert bundle is not None
    final = check_run(bundle, run, views=1)
    assert [check.ok for check in final] == [True, True, True]
    assert "stated" in final[0].detail and final[0].name == "error of the view colours"
    first = min((run / "nerfstudio_models").glob("*.ckpt"))
    earlier = check_run(bundle, first, views=1)
    # contents of the bundle did not exist yet, its folder did
    assert [check.ok for check in earlier] == [False, False, True]
    with pytest.raises(InputError, match="no checkpoint"):
        check_run(bundle, run / "step-7.ckpt", views=1)
