"""From a trained scene to a bundle and back into nerfstudio's tools."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.scripts import train as ns_train
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.bake import BakeOptions, TuneOptions, tune
from bitymi_ns.bundle import check_files
from bitymi_ns.cli import main
from bitymi_ns.host import export as host_export
from bitymi_ns.host import target
from bitymi_ns.host.config import BitymiTrainerConfig
from bitymi_ns.host.errors import InputError
from bitymi_ns.host.export import ExportAtlas, default_export
from bitymi_ns.host.verify import check_run

TOLERANCE = 0.02


def run_export(config: BitymiTrainerConfig, folder: Path, **options: Any) -> None:
    ExportAtlas(load_config=config.get_base_dir() / "config.yml", output_dir=folder, **options).main()


@pytest.fixture(scope="session")
def bundle(trained: BitymiTrainerConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trained room as a bundle, its texels as they were learned. Not to be changed.

    After so few steps little of the residual is worth a tile.
    """
    folder = tmp_path_factory.mktemp("bundles") / "room-bc7"
    run_export(trained, folder, tolerance=TOLERANCE, finetune_steps=0)
    return folder


@pytest.fixture
def copied(bundle: Path, tmp_path: Path) -> Path:
    """The bundle in another place."""
    return Path(shutil.copytree(bundle, tmp_path / "elsewhere"))


def evaluate(config: Path, output: Path) -> dict[str, float]:
    ComputePSNR(load_config=config, output_path=output).main()
    text = output.read_text()
    assert "NaN" not in text
    return json.loads(text)["results"]


def test_a_bundle_has_its_files_and_states_what_the_bake_cost(bundle: Path) -> None:
    assert {p.name for p in bundle.iterdir()} == {
        "bundle.json", "surfels.ply", "atlas.ktx2", "config.yml", "preview.png"
    }  # fmt: skip
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


def test_fine_tuning_mends_an_atlas_that_is_too_dark(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = host_export.bake

    def too_dark(*arguments: Any) -> Any:
        baked = make(*arguments)
        dark = baked.with_mean_residual(baked.mean_residual - 0.3).with_texels(baked.texels - 0.3)
        return replace(dark, statistics=dark.statistics.but(error=baked.statistics.error))

    monkeypatch.setattr(host_export, "bake", too_dark)
    run_export(trained, tmp_path / "b", tolerance=TOLERANCE, finetune_steps=100)
    tuned = json.loads((tmp_path / "b" / "bundle.json").read_text())["statistics"]["finetune"]
    held_in, held_out = tuned["psnr_held_in"], tuned["psnr_held_out"]
    assert held_in["after"] > held_in["before"] + 0.5 and held_out["after"] > held_out["before"] + 0.5
    stored = evaluate(tmp_path / "b" / "config.yml", tmp_path / "tuned.json")["psnr"]
    assert stored == pytest.approx(held_out["after"], abs=0.1)


def test_ctrl_c_in_the_fine_tuning_leaves_nothing(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tune, "photometric", interrupted)
    with pytest.raises(SystemExit) as stop:
        run_export(trained, tmp_path / "b", tolerance=TOLERANCE)
    assert stop.value.code == 130 and list(tmp_path.iterdir()) == []


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
    assert [check.ok for check in final] == [True, True, True]
    assert "stated" in final[0].detail and final[0].name == "error of the view colours"
    first = min((run / "nerfstudio_models").glob("*.ckpt"))
    earlier = check_run(bundle, first, views=1)
    assert not any(check.ok for check in earlier)  # what the bundle holds was not there yet
    with pytest.raises(InputError, match="no checkpoint"):
        check_run(bundle, run / "step-7.ckpt", views=1)


def test_a_scene_without_texture_has_no_atlas(start: Callable[..., BitymiTrainerConfig], tmp_path: Path) -> None:
    config = start(method="bitymi-notexture")
    config.max_num_iterations = 3
    ns_train.main(config)
    run_export(config, tmp_path / "plain")
    assert not (tmp_path / "plain" / "atlas.ktx2").exists()
    assert evaluate(tmp_path / "plain" / "config.yml", tmp_path / "plain.json")["atlas_bytes"] == 0


def test_an_existing_bundle_is_replaced_only_on_request(trained: BitymiTrainerConfig, copied: Path) -> None:
    before = (copied / "bundle.json").read_bytes()
    with pytest.raises(InputError, match="is a bundle already.*--overwrite True"):
        run_export(trained, copied)
    assert (copied / "bundle.json").read_bytes() == before
    run_export(trained, copied, overwrite=True, r_max=8, compare=False, finetune_steps=0)
    info = json.loads((copied / "bundle.json").read_text())
    assert info["statistics"]["options"]["r_max"] == 8 and "held_out" not in info["statistics"]


def test_a_folder_that_is_no_bundle_is_never_replaced(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("x")
    with pytest.raises(InputError, match="is not a bundle"):
        run_export(trained, tmp_path, overwrite=True)
    with pytest.raises(InputError, match="is not a bundle") as stop:
        run_export(trained, tmp_path)
    assert "--overwrite" not in str(stop.value)  # which would not help
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="link is a link to nothing"):
        run_export(trained, tmp_path / "link")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "precious.txt"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"finetune_steps": -1}, "--finetune-steps must not be negative"),
        ({"finetune_memory": math.inf}, "--finetune-memory must be from 0 to"),
        ({"finetune_memory": math.nan}, "--finetune-memory must be from 0 to"),
        ({"page_width": 100}, "page width must be a power of two"),
        ({"r_max": 48}, "r_max must be a power of two"),
        ({"r_max": 8192}, "do not fit pages"),
        ({"seed": -1}, "seed must not be negative"),
    ],
)
def test_options_out_of_range_are_found_before_the_work(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: Any, message: str
) -> None:
    monkeypatch.setattr(host_export, "load_trained", None)  # is not called
    with pytest.raises(InputError, match=message):
        run_export(trained, tmp_path / "b", **options)
    assert list(tmp_path.iterdir()) == []


def test_brackets_in_a_path_are_no_markup(
    trained: BitymiTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "b [bold]" / "[" / "x]"
    run_export(trained, folder, finetune_steps=0, compare=False)
    said = "".join(capsys.readouterr().out.split())
    assert f"--load-config'{folder}/config.yml'".replace(" ", "") in said


def test_a_config_of_another_kind(tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text("just text")
    with pytest.raises(InputError, match="is not the configuration of a trained scene"):
        host_export.load_trained(tmp_path / "config.yml")


def test_ctrl_c_in_the_export_leaves_nothing(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(host_export, "bake", interrupted)
    with pytest.raises(SystemExit) as stop:
        run_export(trained, tmp_path / "b")
    assert stop.value.code == 130
    assert "was not written" in " ".join(capsys.readouterr().out.split())
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_before_a_bundle_is_replaced_says_which_one_is_there(
    trained: BitymiTrainerConfig, copied: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(host_export, "bake", interrupted)
    with pytest.raises(SystemExit):
        run_export(trained, copied, overwrite=True)
    assert "is the earlier one" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("call", "name", "state"),
    [
        ("mkdir", ".elsewhere.new", "is the earlier one"),  # the new one is begun
        ("rename", "elsewhere", "is the earlier one"),  # the earlier one is out of the way
        ("rename", ".elsewhere.new", "is complete"),  # the new one is in its place
    ],
)
def test_ctrl_c_while_a_bundle_is_replaced_says_which_one_is_there(
    trained: BitymiTrainerConfig,
    copied: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    call: str,
    name: str,
    state: str,
) -> None:
    before = (copied / "bundle.json").read_bytes()
    do = getattr(Path, call)

    def interrupted_after(self: Path, *arguments: Any, **options: Any) -> Any:
        result = do(self, *arguments, **options)
        if self.name == name:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(Path, call, interrupted_after)
    with pytest.raises(SystemExit):
        run_export(trained, copied, overwrite=True, r_max=8, compare=False, finetune_steps=0)
    monkeypatch.undo()
    assert state in " ".join(capsys.readouterr().out.split())
    assert ((copied / "bundle.json").read_bytes() == before) == (state == "is the earlier one")
    assert check_files(copied)[0] is not None and [p.name for p in copied.parent.iterdir()] == [copied.name]


def test_ctrl_c_in_the_comparison_says_that_the_bundle_is_complete(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(host_export, "read_bundle", interrupted)
    with pytest.raises(SystemExit):
        run_export(trained, tmp_path / "b", finetune_steps=0)
    assert "is complete" in " ".join(capsys.readouterr().out.split())
    assert check_files(tmp_path / "b")[0] is not None


def test_a_place_that_will_not_do_is_found_before_the_work(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_export, "load_trained", None)  # is not called
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="b cannot be written: .*file is not a folder.*--output-dir"):
        run_export(trained, tmp_path / "file" / "b")
    with pytest.raises(InputError, match="cannot be written: the name is too long"):
        run_export(trained, tmp_path / ("b" * 300))
    monkeypatch.setattr(target, "free_bytes", lambda path: 34_500)
    with pytest.raises(
        InputError, match=r"too little room .*: 34.5 kB are free, .* up to \d.* MB \(a generous estimate"
    ):
        run_export(trained, tmp_path / "b")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_the_estimate_of_a_bundle_is_generous(trained: BitymiTrainerConfig, bundle: Path) -> None:
    size = sum(path.stat().st_size for path in bundle.iterdir())
    config = trained.get_base_dir() / "config.yml"
    needed = [
        target.space_needed(config, BakeOptions(format=name), exact) for name in ("bc7", "fp16") for exact in (0, 1)
    ]
    assert size < needed[0] < needed[1] < needed[3] and needed[0] < needed[2]


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


def test_a_missing_encoder_is_named(
    trained: BitymiTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    with pytest.raises(InputError, match="pip install ispc_texcomp"):
        run_export(trained, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_options_that_make_no_sense(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be baked: .*power of two"):
        run_export(trained, tmp_path / "b", r_min=5)
    assert list(tmp_path.iterdir()) == []


def test_a_configuration_that_is_not_there_or_not_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no .*config.yml"):
        ExportAtlas(load_config=tmp_path / "config.yml", output_dir=tmp_path / "b").main()
    (tmp_path / "config.yml").write_text("a: [")
    with pytest.raises(InputError, match="is not the configuration"):
        ExportAtlas(load_config=tmp_path / "config.yml", output_dir=tmp_path / "b").main()


def test_a_damaged_checkpoint(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(trained.get_base_dir(), tmp_path / "outputs/room/bitymi/run"))
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir = tmp_path / "outputs"
    (folder / "config.yml").write_text(yaml.dump(config))
    path = folder / "nerfstudio_models" / "step-000000059.ckpt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged"):
        ExportAtlas(load_config=folder / "config.yml", output_dir=tmp_path / "b").main()


def test_a_bundle_cannot_be_baked_again(bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="which is baked already"):
        ExportAtlas(load_config=bundle / "config.yml", output_dir=tmp_path / "b").main()


@pytest.mark.parametrize("name", ["surfels.ply", "atlas.ktx2"])
def test_damaged_bundles_are_refused(copied: Path, name: str) -> None:
    path = copied / name
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=f"{name} is truncated.*or export the scene again"):
        eval_setup(copied / "config.yml")
    path.write_bytes(whole[:-9] + bytes(9))
    with pytest.raises(InputError, match=f"{name} is altered"):
        eval_setup(copied / "config.yml")
    path.unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        eval_setup(copied / "config.yml")


def test_a_bundle_of_a_newer_version_is_refused(copied: Path) -> None:
    info = json.loads((copied / "bundle.json").read_text())
    (copied / "bundle.json").write_text(json.dumps({**info, "version": "3.0"}))
    with pytest.raises(InputError, match="version 3.0.*update bitymi-ns"):
        eval_setup(copied / "config.yml")


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


def test_a_configuration_without_its_bundle(copied: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    config = yaml.load((copied / "config.yml").read_text(), Loader=yaml.Loader)
    config.pipeline.model.bundle = tmp_path / "gone"
    (alone / "config.yml").write_text(yaml.dump(config))
    with pytest.raises(InputError, match="no bundle found"):
        eval_setup(alone / "config.yml")


def test_the_presets_bake_options_are_those_of_the_command() -> None:
    options = default_export()
    assert (options.format, options.r_max, options.cap_by_views, options.tolerance) == ("bc7", 64, True, 0.75)
