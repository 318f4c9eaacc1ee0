"""From a trained scene to a bundle and back into nerfstudio's tools."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.bake import BakeOptions, TuneOptions
from bitymi_ns.bake import learn as bake_learn
from bitymi_ns.bundle import check_files
from bitymi_ns.cli import main
from bitymi_ns.host import export as host_export
from bitymi_ns.host import target
from bitymi_ns.host.config import BitymiTrainerConfig
from bitymi_ns.host.errors import InputError
from bitymi_ns.host.export import default_export
from bitymi_ns.host.verify import check_run
from tests.e2e.exports import TOLERANCE, evaluate, run_export


def test_a_bundle_has_its_files_and_states_what_the_bake_cost(bundle: Path) -> None:
    assert {p.name for p in bundle.iterdir()} == {
        "bundle.json", "surfels.ply", "atlas.ktx2", "config.yml", "preview.png", "cameras.json"
    }  # fmt: skip
    cameras = json.loads((bundle / "cameras.json").read_text())["cameras"]
    assert sum(camera["held_out"] for camera in cameras) == 2 and all(
        len(camera["viewmat"]) == 16 for camera in cameras
    )
    info = json.loads((bundle / "bundle.json").read_text())
    held_out = info["statistics"]["held_out"]
    assert held_out["views"] == 2
    assert held_out["psnr_baked_against_neural"] > 35
    assert held_out["psnr_baked_against_photos"] == pytest.approx(held_out["psnr_neural_against_photos"], abs=0.2)
    assert info["statistics"]["options"]["format"] == "bc7" and "finetune" not in info["statistics"]
    assert torch.tensor(info["world"]["transform"]).shape == (3, 4)


def test_stock_evaluation_of_checkpoint_and_bundle_agree(
    trained: BitymiTrainerConfig, bundle: Path, tmp_path: Path
) -> None:
    neural = evaluate(trained.get_base_dir() / "config.yml", tmp_path / "neural.json")
    baked = evaluate(bundle / "config.yml", tmp_path / "baked.json")
    for name in ("psnr", "ssim", "surfels", "render_ms", "fragments_per_pixel"):
        assert math.isfinite(neural[name]) and math.isfinite(baked[name])
    assert baked["psnr"] == pytest.approx(neural["psnr"], abs=0.2)
    assert baked["atlas_bytes"] == (bundle / "atlas.ktx2").stat().st_size
    assert "atlas_bytes" not in neural
    assert ("lpips" in neural) == ("lpips" in baked)


def test_a_bundle_needs_neither_checkpoint_nor_its_old_place(
    bundle: Path, copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = yaml.load((copied / "config.yml").read_text(), Loader=yaml.Loader)
    config.pipeline.model.bundle = Path("/no/longer/there")
    (copied / "config.yml").write_text(yaml.dump(config))
    monkeypatch.chdir(tmp_path)
    _, pipeline, path, _ = eval_setup(Path("elsewhere") / "config.yml")
    assert pipeline.model.config.bundle == copied
    assert path.parts[-3] == "elsewhere"
    camera, _ = pipeline.datamanager.eval_view(0)
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert outputs["rgb"].shape == (36, 48, 3) and {"depth", "normal", "overdraw"} <= outputs.keys()


def test_the_texels_are_fine_tuned(
    trained: BitymiTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_export(trained, tmp_path / "b", tolerance=TOLERANCE, finetune_steps=30)
    statistics = json.loads((tmp_path / "b" / "bundle.json").read_text())["statistics"]
    tuned = statistics["finetune"]
    assert tuned["steps"] <= 30 and tuned["views"] + tuned["held_in_views"] == 10 and tuned["cpu_seconds"] > 0
    held_in, held_out = tuned["psnr_held_in"], tuned["psnr_held_out"]
    assert held_in["after"] == max(psnr for _, psnr in tuned["curve"])
    assert held_out["before"] == pytest.approx(statistics["held_out"]["psnr_neural_against_photos"], abs=0.2)
    stored = evaluate(tmp_path / "b" / "config.yml", tmp_path / "tuned.json")["psnr"]
    assert stored == pytest.approx(held_out["after"], abs=0.1)
    out = " ".join(capsys.readouterr().out.split())
    assert "tuning texels" in out and "Fine-tuning" in out
    assert "30 steps for 10 training photographs, 3.0 for each: more may gain" in out
    assert "The export will take about" in out and "GB of memory for 10 training photographs of 48 x 36" in out


def test_the_scene_is_polished(
    trained: BitymiTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_export(trained, tmp_path / "b", tolerance=TOLERANCE, polish_steps=30, finetune_steps=8)
    statistics = json.loads((tmp_path / "b" / "bundle.json").read_text())["statistics"]
    polished, tuned = statistics["polish"], statistics["finetune"]
    assert polished["steps"] <= 30 and polished["views"] + polished["held_in_views"] == 10
    assert polished["psnr_held_in"]["after"] == max(psnr for _, psnr in polished["curve"])
    assert tuned["psnr_held_in"]["before"] == pytest.approx(polished["psnr_held_in"]["after"], abs=0.1)
    assert "error_before" not in polished and "error_before" not in tuned and "error" not in statistics
    texels = statistics["texels"]
    assert 0 < texels["kept"] <= texels["polished"] <= texels["within_visible_part"]
    stored = evaluate(tmp_path / "b" / "config.yml", tmp_path / "polished.json")["psnr"]
    assert stored == pytest.approx(tuned["psnr_held_out"]["after"], abs=0.1)
    out = " ".join(capsys.readouterr().out.split())
    assert "polishing" in out and "Polish" in out and "Fine-tuning" in out
    bundle, checks = check_files(tmp_path / "b")
    assert bundle is not None and all(check.ok for check in checks)
    found = {check.name: check for check in check_run(bundle, trained.get_base_dir() / "config.yml", views=1)}
    assert all(check.ok for check in found.values())
    assert "the surfels learned after the bake" in found["error of the view colours"].detail
    assert "the texels were changed" in found["error against the field"].detail


def test_fine_tuning_mends_an_atlas_that_is_too_dark(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = bake_learn.bake

    def too_dark(*arguments: Any) -> Any:
        baked = make(*arguments)
        dark = baked.with_mean_residual(baked.mean_residual - 0.3).with_texels(baked.texels - 0.3)
        return replace(dark, statistics=dark.statistics.but(error=baked.statistics.error))

    monkeypatch.setattr(bake_learn, "bake", too_dark)
    run_export(trained, tmp_path / "b", tolerance=TOLERANCE, finetune_steps=100)
    tuned = json.loads((tmp_path / "b" / "bundle.json").read_text())["statistics"]["finetune"]
    held_in, held_out = tuned["psnr_held_in"], tuned["psnr_held_out"]
    assert held_in["after"] > held_in["before"] + 0.5 and held_out["after"] > held_out["before"] + 0.5
    stored = evaluate(tmp_path / "b" / "config.yml", tmp_path / "tuned.json")["psnr"]
    assert stored == pytest.approx(held_out["after"], abs=0.1)


@pytest.mark.parametrize("format", ["uint8", "fp16"])
def test_other_formats(trained: BitymiTrainerConfig, tmp_path: Path, format: str) -> None:
    run_export(trained, tmp_path / format, format=format, tolerance=TOLERANCE, finetune_steps=0)
    info = json.loads((tmp_path / format / "bundle.json").read_text())
    assert info["atlas"]["format"] == format


def test_exact_keeps_everything_and_a_tolerance_states_what_it_saves(
    trained: BitymiTrainerConfig, bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_export(trained, tmp_path / "exact", exact=True)
    printed = capsys.readouterr().out
    exact, default = (json.loads((f / "bundle.json").read_text())["statistics"] for f in (tmp_path / "exact", bundle))
    assert exact["texels"]["kept"] == exact["texels"]["nyquist"] == default["texels"]["nyquist"]
    assert 0 < default["texels"]["kept"] < 0.8 * exact["texels"]["kept"]
    assert exact["surfels"]["left_out"].get("unseen", 0) == 0 and exact["options"]["tolerance"] == 0
    assert "Atlas bytes" in printed and "no tolerance" in printed and "all of it is kept" in printed
    assert "view_color" not in exact and default["view_color"]["tolerance"] == TOLERANCE
    assert default["view_color"]["sites"]["after"] < default["view_color"]["sites"]["before"]
    assert default["error"]["tolerance"] == TOLERANCE and 0 < default["error"]["rms"]["p90"] < 1


def test_verify_compares_a_bundle_with_its_run(
    trained: BitymiTrainerConfig, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained.get_base_dir()
    assert main(["verify", str(copied), "--run", str(run / "config.yml")]) == 0
    assert "error against the field" in capsys.readouterr().out
    bundle, _ = check_files(copied)
    assert bundle is not None
    final = check_run(bundle, run, views=1)
    assert [check.ok for check in final] == [True, True, True, True]
    assert "stated" in final[0].detail and final[0].name == "error of the view colours"
    first = min((run / "nerfstudio_models").glob("*.ckpt"))
    earlier = check_run(bundle, first, views=1)
    # what the bundle holds was not there yet, its place was
    assert [check.ok for check in earlier] == [False, False, False, True]
    with pytest.raises(InputError, match="no checkpoint"):
        check_run(bundle, run / "step-7.ckpt", views=1)


def test_a_scene_without_texture_has_no_atlas(start: Callable[..., BitymiTrainerConfig], tmp_path: Path) -> None:
    config = start(method="bitymi-notexture")
    config.max_num_iterations = 3
    ns_train.main(config)
    run_export(config, tmp_path / "plain")
    assert not (tmp_path / "plain" / "atlas.ktx2").exists()
    assert evaluate(tmp_path / "plain" / "config.yml", tmp_path / "plain.json")["atlas_bytes"] == 0


def test_brackets_in_a_path_are_no_markup(
    trained: BitymiTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "b [bold]" / "[" / "x]"
    run_export(trained, folder, finetune_steps=0, compare=False)
    said = "".join(capsys.readouterr().out.split())
    assert f"--load-config'{folder}/config.yml'".replace(" ", "") in said


def test_the_estimate_of_a_bundle_is_generous(trained: BitymiTrainerConfig, bundle: Path) -> None:
    size = sum(path.stat().st_size for path in bundle.iterdir())
    config = trained.get_base_dir() / "config.yml"
    needed = [
        target.space_needed(config, BakeOptions(format=name), exact) for name in ("bc7", "fp16") for exact in (0, 1)
    ]
    assert size < needed[0] < needed[1] < needed[3] and needed[0] < needed[2]


def test_a_run_without_a_field_gets_texels_from_the_photographs(
    start: Callable[..., BitymiTrainerConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = start(method="bitymi-notexture")
    ns_train.main(config)
    run_export(config, tmp_path / "b", polish_steps=None, tolerance=0.2)  # as many steps as by default
    bundle, checks = check_files(tmp_path / "b")
    assert all(check.ok for check in checks) and bundle.scene.atlas is not None
    statistics = bundle.info.statistics
    assert statistics.polish.steps_asked == 300 and statistics.finetune.steps_asked == 100
    assert statistics.texels.paper is None and 0 < statistics.texels.kept <= statistics.texels.polished
    against = statistics.held_out
    assert against.psnr_baked_against_photos > against.psnr_neural_against_photos
    out = " ".join(capsys.readouterr().out.split())
    assert "by the pixels that show them: polished" in out and "paper's rule" not in out
    found = {check.name: check for check in check_run(bundle, config.get_base_dir() / "config.yml", views=1)}
    assert all(check.ok for check in found.values()) and "error against the field" not in found


def test_a_fine_tuning_that_ends_early_says_so(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wild = partial(TuneOptions, rate=50.0, patience=2)
    monkeypatch.setattr(host_export, "TuneOptions", wild)
    run_export(trained, tmp_path / "b", tolerance=TOLERANCE, finetune_steps=40, compare=False)
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    steps = json.loads((tmp_path / "b" / "bundle.json").read_text())["statistics"]["finetune"]["steps"]
    assert steps < 40
    assert f"stopped early at step {steps} of 40: no gain on the set-aside training views for" in out
    assert "tuning texels ━" in out and "100%" in out.split("tuning texels")[-1][:80]


def test_a_run_is_found_beside_its_configuration(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(shutil.copytree(trained.get_base_dir(), tmp_path / "moved"))
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir = Path("outputs")  # as recorded by default: relative to the folder of the training
    (folder / "config.yml").write_text(yaml.dump(config))
    monkeypatch.chdir(tmp_path)
    _, _, path, step = eval_setup(Path("moved/config.yml"))
    assert path.parent == folder / "nerfstudio_models" and step == 59


def test_the_options_of_the_command_are_the_declared_defaults() -> None:
    options = default_export()
    assert (options.format, options.r_max, options.cap_by_views, options.tolerance) == ("bc7", 64, True, 0.75)
