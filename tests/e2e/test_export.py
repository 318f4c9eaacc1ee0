"""From a trained scene to a bundle and back into nerfstudio's tools."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.bake import BakeOptions
from bitymi_ns.bundle import check_files
from bitymi_ns.ops.constants import TRANSMITTANCE_MIN
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export import target
from bitymi_ns.plugin.run.bundle_model import RENDERER
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from bitymi_ns.scene.baked import FAST
from tests.e2e.exports import TOLERANCE, evaluate, run_export
from tests.e2e.runs import a_run_of, rewrite
from tests.typed import Patch, Printed


def test_a_bundle_has_its_files_and_states_what_the_bake_cost(bundle: Path) -> None:
    assert {p.name for p in bundle.iterdir()} == {
        "bundle.json", "surfels.ply", "atlas.ktx2", "config.yml", "preview.png", "cameras.json", "poster.webp"
    }  # fmt: skip
    cameras = json.loads((bundle / "cameras.json").read_text())["cameras"]
    assert sum(camera["held_out"] for camera in cameras) == 2
    assert all(len(camera["viewmat"]) == 16 for camera in cameras)
    info = json.loads((bundle / "bundle.json").read_text())
    held_out = info["statistics"]["held_out"]
    assert held_out["views"] == 2
    assert held_out["psnr_baked_against_neural"] > 33  # BC7 with alpha
    assert held_out["psnr_baked_against_photos"] == pytest.approx(held_out["psnr_neural_against_photos"], abs=0.2)
    assert info["statistics"]["options"]["format"] == "bc7" and "finetune" not in info["statistics"]
    assert torch.tensor(info["world"]["transform"]).shape == (3, 4)


def test_evaluations_of_checkpoint_and_bundle_agree(trained: Run, bundle: Path, tmp_path: Path) -> None:
    neural = evaluate(trained.get_base_dir() / "config.yml", tmp_path / "neural.json")
    baked = evaluate(bundle / "config.yml", tmp_path / "baked.json")
    for name in ("psnr", "ssim", "surfels", "render_ms", "fragments_per_pixel"):
        assert math.isfinite(neural[name]) and math.isfinite(baked[name])
    assert baked["psnr"] == pytest.approx(neural["psnr"], abs=0.2)
    assert baked["atlas_bytes"] == (bundle / "atlas.ktx2").stat().st_size
    whole = sum(path.stat().st_size for path in bundle.iterdir() if path.name != "config.yml")
    assert baked["bundle_bytes"] == whole
    assert "atlas_bytes" not in neural and "bundle_bytes" not in neural
    assert ("lpips" in neural) == ("lpips" in baked)


def test_a_bundle_may_be_moved(bundle: Path, copied: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    rewrite(copied, lambda config: setattr(config.pipeline.model, "bundle", Path("/no/longer/there")))
    monkeypatch.chdir(tmp_path)
    _, pipeline, path, _ = eval_setup(Path("elsewhere") / "config.yml")
    assert pipeline.model.config.bundle == copied
    assert path.parent.name == "elsewhere"
    camera, _ = pipeline.datamanager.eval_view(0)
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert outputs["rgb"].shape == (36, 48, 3) and {"depth", "normal", "overdraw"} <= outputs.keys()


def test_extras_are_written_beside_the_bundle(trained: Run, tmp_path: Path) -> None:
    (tmp_path / "b.extras").mkdir()
    (tmp_path / "b.extras" / "mine").touch()
    with pytest.raises(SystemExit):
        run_export(trained, tmp_path / "b", extras=("gaussians",))
    assert not (tmp_path / "b").exists()  # refused before the work
    (tmp_path / "b.extras" / "mine").unlink()
    run_export(trained, tmp_path / "b", extras=("gaussians", "mesh"), finetune_steps=0, tolerance=TOLERANCE)
    stated = json.loads((tmp_path / "b.extras" / "extras.json").read_text())
    assert stated["training_views"] > 2
    for kind in ("gaussians", "mesh"):
        assert stated[kind]["count"] > 0 and stated[kind]["bytes"] > 0


def test_a_scene_without_texture_has_no_atlas(start: Callable[..., Run], tmp_path: Path) -> None:
    config = start(method="bitymi-notexture")
    config.max_num_iterations = 3
    ns_train.main(config)
    for name, options in (("plain", {}), ("polished", {"polish_steps": None})):
        run_export(config, tmp_path / name, **options)
        assert not (tmp_path / name / "atlas.ktx2").exists()
    assert evaluate(tmp_path / "plain" / "config.yml", tmp_path / "plain.json")["atlas_bytes"] == 0


def test_the_estimate_of_a_bundle_is_generous(trained: Run, bundle: Path) -> None:
    size = sum(path.stat().st_size for path in bundle.iterdir())
    config = trained.get_base_dir() / "config.yml"
    kinds = [(name, exact) for name in ("bc7", "fp16") for exact in (0, 1)]
    needed = [target.space_needed(config, BakeOptions(format=name), exact) for name, exact in kinds]
    assert size < needed[0] < needed[1] < needed[3] and needed[0] < needed[2]


def test_texels_that_learned_are_the_atlas(trained: Run, tmp_path: Path, capsys: Printed) -> None:
    folder = tmp_path / "b [bold]" / "[" / "x]"  # brackets in a path are not console markup
    run_export(trained, folder, polish_steps=None, tolerance=0.2)  # default number of steps
    bundle, checks = check_files(folder)
    assert all(check.ok for check in checks) and bundle.scene.atlas is not None
    statistics = bundle.info.statistics
    assert statistics.polish is None and statistics.finetune.steps_asked == 100
    assert statistics.texels.paper is None and 0 < statistics.texels.kept <= statistics.texels.learned
    against = statistics.held_out
    assert against.psnr_baked_against_photos > against.psnr_neural_against_photos - 0.3
    out = " ".join(capsys.readouterr().out.split())
    assert "Texels that learned" in out and "paper's rule" not in out
    assert f"--load-config'{folder}/config.yml'".replace(" ", "") in out.replace(" ", "")
    run_export(trained, tmp_path / "exact", exact=True)
    exact = json.loads((tmp_path / "exact" / "bundle.json").read_text())["statistics"]
    assert exact["texels"]["kept"] == exact["texels"]["learned"] and "view_color" not in exact
    assert exact["held_out"]["psnr_baked_against_neural"] > 33  # BC7 with alpha


def test_a_bundle_is_drawn_by_the_renderer_that_is_asked_for(copied: Path, monkeypatch: Patch) -> None:
    def least() -> float:
        return eval_setup(copied / "config.yml")[1].model._renderer.scene.transmittance_min

    assert least() == TRANSMITTANCE_MIN
    monkeypatch.setenv(RENDERER, "fast")
    assert least() == FAST
    monkeypatch.setenv(RENDERER, "quick")
    with pytest.raises(InputError, match="must be kernels, fast or webgpu, not 'quick'"):
        least()


def test_a_run_is_found_by_its_config(trained: Run, tmp_path: Path, monkeypatch: Patch) -> None:
    folder = a_run_of(trained, tmp_path)
    # as recorded by default: relative to the folder of the training
    rewrite(folder, lambda config: setattr(config, "output_dir", Path("outputs")))
    monkeypatch.chdir(tmp_path)
    _, _, path, step = eval_setup(Path("run/config.yml"))
    assert path.parent == folder / "nerfstudio_models" and step == 59
