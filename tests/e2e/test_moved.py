"""Runs and bundles whose capture was moved or deleted, and nerfstudio commands that do not support surfels."""

import hashlib
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.scripts import exporter, render
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

import bitymi_ns
from bitymi_ns import cli
from bitymi_ns.bundle import strict_json
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.hooks import REFUSED
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from bitymi_ns.plugin.run.render import OUTPUTS
from bitymi_ns.sample import generate
from tests.e2e.exports import evaluate
from tests.e2e.runs import a_run_of, rewrite
from tests.typed import Patch, Printed


@pytest.fixture
def alone(copied: Path) -> Path:
    for part in ("datamanager", "datamanager.dataparser"):
        of = attrgetter(f"pipeline.{part}")
        rewrite(copied, lambda config, of=of: setattr(of(config), "data", Path("/no/longer/there")))
    return copied


def test_a_bundle_alone_has_the_cameras_of_its_capture(bundle: Path, alone: Path) -> None:
    before, now = (eval_setup(each / "config.yml")[1].datamanager for each in (bundle, alone))
    for name in ("train_dataset", "eval_dataset"):
        a, b = getattr(before, name), getattr(now, name)
        assert [path.name for path in a.image_filenames] == [path.name for path in b.image_filenames]
        assert torch.allclose(a.cameras.camera_to_worlds, b.cameras.camera_to_worlds, atol=1e-5)
        assert torch.equal(a.cameras.fx, b.cameras.fx) and torch.equal(a.cameras.width, b.cameras.width)


def test_names_of_a_bundle_alone_lead_nowhere_else(alone: Path, tmp_path: Path) -> None:
    info = json.loads((alone / "bundle.json").read_text())
    cameras = json.loads((alone / "cameras.json").read_text())
    cameras["cameras"][0]["name"] = "../../somewhere.png"
    data = json.dumps(cameras).encode()
    (alone / "cameras.json").write_bytes(data)
    info["files"]["cameras.json"].update(bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
    info.pop("digest")
    (alone / "bundle.json").write_text(json.dumps({**info, "digest": strict_json.digest(info)}))
    with pytest.raises(InputError, match=r"cameras.json: the name '../../somewhere.png' leads elsewhere"):
        eval_setup(alone / "config.yml")


def test_films_and_cameras_need_a_bundle_alone(alone: Path, tmp_path: Path) -> None:
    options: Any = {"load_config": alone / "config.yml", "output_path": tmp_path / "film.mp4"}
    render.RenderInterpolated(pose_source="train", interpolation_steps=2, **options).main()
    render.SpiralRender(seconds=0.5, **options).main()
    assert (tmp_path / "film.mp4").stat().st_size > 0
    exporter.ExportCameraPoses(load_config=alone / "config.yml", output_dir=tmp_path / "cameras").main()
    assert len(list((tmp_path / "cameras").iterdir())) == 2


@pytest.mark.parametrize("names", [None, ["rgb", "raw-depth"]])
def test_the_cameras_of_a_bundle_alone_are_drawn(alone: Path, tmp_path: Path, names: list[str] | None) -> None:
    options: Any = {"load_config": alone / "config.yml", "output_path": tmp_path, "rendered_output_names": names}
    render.DatasetRender(split="train", **options).main()
    drawn = {path.name: len(list(path.iterdir())) for path in (tmp_path / "train").iterdir()}
    every = set(OUTPUTS) - {"rgba"} if names is None else set(names)
    assert drawn.keys() == every and len(set(drawn.values())) == 1 and drawn["rgb"] > 5
    options["rendered_output_names"] = ["rgb", "gt-rgb"]
    with pytest.raises(InputError, match="the capture is gone"):
        render.DatasetRender(split="test", **options).main()


def test_the_viewer_needs_a_bundle_alone(alone: Path, monkeypatch: Patch, tmp_path: Path) -> None:
    shown = []

    def start_viewer(config: Any, pipeline: Any, step: int) -> None:
        shown.append((config.get_base_dir(), pipeline.datamanager.train_dataset[0]["image"]))

    monkeypatch.setattr(run_viewer, "_start_viewer", start_viewer)
    monkeypatch.chdir(tmp_path)
    run_viewer.RunViewer(load_config=alone / "config.yml").main()
    ((folder, image),) = shown
    assert folder == alone and image.shape == (36, 48, 3) and image.std() == 0
    assert not (tmp_path / "no").exists()


def test_missing_photographs_can_be_named(alone: Path, room: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    with pytest.raises(InputError, match="/no/longer/there/frame.* the capture is gone. .* `BITYMI_DATA=/where/it/is`"):
        evaluate(alone / "config.yml", tmp_path / "out.json")
    moved = Path(shutil.copytree(room, tmp_path / "moved"))
    monkeypatch.setenv("BITYMI_DATA", str(moved))
    assert evaluate(alone / "config.yml", tmp_path / "out.json")["psnr"] > 10
    monkeypatch.setenv("BITYMI_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="BITYMI_DATA names .*nowhere as the capture, which does not exist"):
        eval_setup(alone / "config.yml")


def test_a_bundle_needs_its_own_capture(bundle: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    """Any other has cameras elsewhere, as has the same one in another frame."""
    other = generate(tmp_path / "other", views=8, width=48, height=36, seed=1)
    monkeypatch.setenv("BITYMI_DATA", str(other))
    rewrite(copy := Path(shutil.copytree(bundle, tmp_path / "copy")), lambda config: None)
    with pytest.raises(InputError, match=r"copy is not of the capture .*other, or of its frame: half of its cameras"):
        evaluate(copy / "config.yml", tmp_path / "out.json")


def test_a_bundle_without_run_has_its_captures_frame(room: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    views, points, colors = bitymi_ns.load_capture(room)
    scene, log = bitymi_ns.train_scene(views, points, colors, steps=60, eval_views=views[:2])
    bitymi_ns.bake_scene(scene, views, tmp_path / "b")
    assert cli.main(["unpack", str(tmp_path / "b"), "--output", str(tmp_path / "c")]) == 0
    monkeypatch.setenv("BITYMI_DATA", str(room))
    found = evaluate(tmp_path / "c" / "config.yml", tmp_path / "out.json")
    assert found["psnr"] == pytest.approx(log.entries[-1].psnr, abs=2.5)


@pytest.mark.slow
def test_a_runs_capture_was_moved(
    trained: Run, room: Path, tmp_path: Path, monkeypatch: Patch, capsys: Printed
) -> None:
    run = a_run_of(trained, tmp_path)
    rewrite(run, lambda config: setattr(config.pipeline.datamanager, "data", Path("/no/longer/there")))
    rewrite(run, lambda config: setattr(config, "output_dir", Path("outputs")))  # relative to the training's folder
    with pytest.raises(InputError) as refused:
        eval_setup(run / "config.yml")
    assert "/no/longer/there does not exist. If it was moved, say where it is now: `BITYMI_DATA" in str(refused.value)
    assert "--data" not in str(refused.value)
    monkeypatch.setenv("BITYMI_DATA", str(room))
    config, pipeline, _, _ = eval_setup(run / "config.yml")
    assert config.get_base_dir() == run and len(pipeline.datamanager.eval_dataset) == 2
    assert "another capture" not in " ".join(capsys.readouterr().out.split())
    monkeypatch.setenv("BITYMI_DATA", str(generate(tmp_path / "other", views=12, width=48, height=36, seed=1)))
    eval_setup(run / "config.yml")
    assert "The run was trained on another capture: " in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_commands_that_need_rays(name: str, bundle: Path, trained: Run, tmp_path: Path) -> None:
    folders = (bundle, trained.get_base_dir()) if name == "ExportGaussianSplat" else (bundle,)
    for folder in folders:
        with pytest.raises(InputError, match="ns-export .*bitymi extras"):
            getattr(exporter, name)(load_config=folder / "config.yml", output_dir=tmp_path).main()


def test_a_refusal_ends_no_thread_of_the_viewer(bundle: Path, capsys: Printed) -> None:
    _, pipeline, _, _ = eval_setup(bundle / "config.yml")
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    seen = pipeline.model.get_outputs_for_camera(camera)
    camera.camera_type[:] = CameraType.EQUIRECTANGULAR.value
    with pytest.raises(InputError, match="equirectangular cannot be rendered"):
        pipeline.model.get_outputs_for_camera(camera)
    with ThreadPoolExecutor(1) as thread:
        outputs = [thread.submit(pipeline.model.get_outputs_for_camera, camera).result() for _ in range(2)]
    assert {name: value.shape for name, value in outputs[1].items()} == {n: v.shape for n, v in seen.items()}
    assert capsys.readouterr().out.count("equirectangular cannot be rendered") == 1


def test_a_crop_box_hides_surfels(bundle: Path, trained: Run) -> None:
    box = OrientedBox.from_params((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.8, 0.8, 0.8))
    for folder in (bundle, trained.get_base_dir()):
        _, pipeline, _, _ = eval_setup(folder / "config.yml")
        model, camera = pipeline.model, pipeline.datamanager.eval_dataset.cameras[:1]
        whole, some, again, nothing = (
            model.get_outputs_for_camera(camera, obb_box=each)["accumulation"]
            for each in (None, box, None, OrientedBox.from_params((99.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
        )
        assert torch.equal(whole, again) and 0 < some.mean() < 0.9 * whole.mean() and not nothing.any()


def test_a_bundle_is_drawn_with_its_crop(copied: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("BITYMI_CROP", "True")
    with pytest.raises(InputError, match=r"notes\.json hides no surfels: save a crop .* ask for it\.$"):
        eval_setup(copied / "config.yml")
    crop = {"box": {"center": [0, 0, 0], "half": [0.4, 0.4, 0.4], "quat": [1, 0, 0, 0]}}
    notes = {"format": "bitymi-notes", "version": 2, "views": [], "notes": [], "crop": crop}
    (copied / "notes.json").write_text(json.dumps({**notes, "version": 3}))
    with pytest.raises(InputError, match=r"version 3 is newer than 2: update bitymi-ns to read it\.$"):
        eval_setup(copied / "config.yml")
    (copied / "notes.json").write_text(json.dumps(notes))
    some = eval_setup(copied / "config.yml")[1].model.sizes()["surfels"]
    monkeypatch.setenv("BITYMI_CROP", "False")
    assert 0 < some < eval_setup(copied / "config.yml")[1].model.sizes()["surfels"]
    monkeypatch.setenv("BITYMI_CROP", "yes")
    with pytest.raises(InputError, match="BITYMI_CROP must be True or False, not 'yes'"):
        eval_setup(copied / "config.yml")


def test_lens_photographs_are_rendered(bundle: Path, room: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    capture = Path(shutil.copytree(room, tmp_path / "room"))
    meta = json.loads((capture / "transforms.json").read_text())
    (capture / "transforms.json").write_text(json.dumps({**meta, "k1": 0.08, "k2": -0.01}))
    monkeypatch.setenv("BITYMI_DATA", str(capture))
    render.DatasetRender(load_config=bundle / "config.yml", output_path=tmp_path / "out", split="test").main()
    (picture,) = [path for path in (tmp_path / "out").rglob("*frame_00009*") if "gt-rgb" in str(path)]
    (drawn,) = [path for path in (tmp_path / "out").rglob("*frame_00009*") if path.parent.name == "rgb"]
    sizes = {Image.open(path).size for path in (picture, drawn)}
    assert len(sizes) == 1 and sizes.pop()[0] < 48  # cropped, as the edges lie outside the photograph
