"""Training through nerfstudio's own entry point: what it leaves behind, every method, and what it starts from."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.plugin.run.config import BitymiTrainerConfig
from bitymi_ns.train import init
from tests.e2e.runs import Start, checkpoint, config_of


def test_a_run_leaves_a_configuration_checkpoints_and_a_curve(trained: BitymiTrainerConfig) -> None:
    folder = trained.get_base_dir()
    assert config_of(folder).max_num_iterations == 60
    saved = sorted(p.name for p in trained.get_checkpoint_dir().iterdir())
    assert saved == ["step-000000020.ckpt", "step-000000040.ckpt", "step-000000059.ckpt"]
    points = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert [p["step"] for p in points] == [20, 40, 60]
    assert {"seconds", "cpu_seconds", "surfels", "fragments", "psnr"} <= points[-1].keys()
    assert points[-1]["seconds"] > points[0]["seconds"] > 0
    assert points[-1]["psnr"] > 8


def test_a_run_starts_with_as_many_surfels_as_its_steps_can_place(
    room: Path, start: Start, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(init, "FEWEST_FIRST", 10)
    config = start()
    config.max_num_iterations = 5
    ns_train.main(config)
    said = " ".join(capsys.readouterr().out.split())
    assert "starts from 10 surfels: 190 of 200 points" in said and "train.first-surfels" in said
    resumed = start(name="resumed")
    resumed.max_num_iterations, resumed.load_dir = 8, config.get_checkpoint_dir()
    ns_train.main(resumed)  # which densification may double as before, however many points there are
    assert [
        checkpoint(*of)["pipeline"]["_model._extra_state"]["first_surfels"] for of in ((config, 4), (resumed, 7))
    ] == [10, 10]


def test_the_number_of_surfels_changes_in_the_run(trained: BitymiTrainerConfig) -> None:
    counts = {len(checkpoint(trained, s)["pipeline"]["_model.scene.surfels.means"]) for s in (20, 40, 59)}
    assert len(counts) > 1


@pytest.mark.parametrize(
    ("group", "option", "value", "message"),
    [
        ("scene", "levels", 5, "levels must be between 1 and 4"),
        ("scene", "sv_sites", 40, "sv_sites must be between 1 and 32"),
        ("train", "init_opacity", 1.0, "init_opacity must lie between 0 and 1"),
        ("train", "freeze_every", 0, "out of range .*freeze_every"),
    ],
)
def test_options_out_of_range(start: Start, group: str, option: str, value: Any, message: str) -> None:
    config = start()
    setattr(getattr(config.pipeline.model, group), option, value)
    with pytest.raises(InputError, match=message):
        ns_train.main(config)


@pytest.mark.parametrize("method", ["bitymi-fast", "bitymi-sh", "bitymi-sb", "bitymi-sg", "bitymi-notexture"])
def test_every_method_trains_and_loads_again(start: Start, method: str) -> None:
    config = start(method=method)
    config.max_num_iterations = 3
    ns_train.main(config)
    _, pipeline, _, step = eval_setup(config.get_base_dir() / "config.yml")
    assert step == 2
    camera, batch = pipeline.datamanager.eval_view(0)
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert {"rgb", "accumulation", "depth", "normal", "beta", "overdraw"} <= outputs.keys()
    assert all(value.shape[:2] == (36, 48) and value.isfinite().all() for value in outputs.values())
    metrics, images = pipeline.model.get_image_metrics_and_images(outputs, batch)
    assert {"psnr", "ssim", "surfels", "render_ms", "fragments_per_pixel"} <= metrics.keys()
    assert images["img"].shape == (36, 96, 3)


def spoiled_points(room: Path, folder: Path, rows: slice) -> Path:
    """The room with NaN in some rows of its point cloud."""
    import numpy as np
    import open3d as o3d

    capture = Path(shutil.copytree(room, folder / "spoiled"))
    path = capture / json.loads((capture / "transforms.json").read_text())["ply_file_path"]
    cloud = o3d.io.read_point_cloud(str(path))
    points = np.asarray(cloud.points)
    points[rows] = np.nan
    cloud.points = o3d.utility.Vector3dVector(points)
    o3d.io.write_point_cloud(str(path), cloud)
    return capture


def test_points_that_are_nan_are_left_out_and_counted(
    room: Path, start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = start(data=spoiled_points(room, tmp_path, slice(3, 8)))
    config.max_num_iterations = 2
    ns_train.main(config)
    out = " ".join(capsys.readouterr().out.split())
    assert "5 of 200 points" in out
    assert "Training will take about" in out and "GB of memory for 10 training photographs of 48 x 36" in out


def test_a_cloud_of_nothing_but_nan(room: Path, start: Start, tmp_path: Path) -> None:
    config = start(data=spoiled_points(room, tmp_path, slice(None)))
    with pytest.raises(InputError, match="all 200 points .* are NaN"):
        ns_train.main(config)


def without_points(room: Path, folder: Path) -> Path:
    capture = Path(shutil.copytree(room, folder / "pointless"))
    meta = json.loads((capture / "transforms.json").read_text())
    meta.pop("ply_file_path")
    (capture / "transforms.json").write_text(json.dumps(meta))
    return capture


def with_an_empty_cloud(room: Path, folder: Path) -> Path:
    capture = Path(shutil.copytree(room, folder / "empty"))
    cloud = capture / "sparse_pc.ply"
    header = cloud.read_bytes().partition(b"end_header\n")[0]
    cloud.write_bytes(header.replace(b"vertex 200", b"vertex 0") + b"end_header\n")
    return capture


@pytest.mark.parametrize("pointless", [without_points, with_an_empty_cloud])
def test_a_capture_without_points_starts_at_random(
    room: Path, start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str], pointless: Callable[..., Path]
) -> None:
    config = start(data=pointless(room, tmp_path))
    config.max_num_iterations, config.pipeline.model.train.random_points = 2, 300
    ns_train.main(config)
    assert "Surfels are made of 300 random points" in " ".join(capsys.readouterr().out.split())


def test_no_points_and_an_empty_scene_box(room: Path, start: Start, tmp_path: Path) -> None:
    config = start(data=without_points(room, tmp_path))
    config.pipeline.datamanager.dataparser.scene_scale = 0.0
    with pytest.raises(InputError, match="scene box of the capture, .*, is empty. .*--scene-scale"):
        ns_train.main(config)


def test_evaluation_of_batches_while_training(start: Start) -> None:
    config = start(name="batches")
    config.max_num_iterations, config.steps_per_eval_batch = 6, 2
    ns_train.main(config)
    assert config.get_checkpoint_dir().is_dir()


def test_a_seed_that_numpy_does_not_take(start: Start) -> None:
    config = start(name="seed")
    config.machine.seed = -1
    with pytest.raises(InputError, match="--machine.seed must be from 0 to 4294967295, not -1"):
        ns_train.main(config)
