"""Command lines of `bitymi bench` work with nerfstudio: standard layouts, seeds, own captures."""

import shutil
from pathlib import Path

import pytest
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.measure.bench.engine import CURVE, train_command
from bitymi_ns.measure.bench.matrix import Cell, standard_scenes
from bitymi_ns.measure.bench.process import run_measured
from bitymi_ns.measure.report.read import read_jsonl
from tests.captures import colmap_model

SMALL = (
    "--pipeline.model.scene.log2-table-size", "10", "--pipeline.model.scene.min-resolution", "16",
    "--logging.local-writer.enable", "False", "--pipeline.model.curve-points", "1",
)  # fmt: skip


@pytest.mark.slow
def test_a_scene_of_mipnerf360(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "360/bonsai"  # as COLMAP would write it, with images at half the size that COLMAP saw
    colmap_model(room, folder / "sparse/0")
    (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 96 72 80 80 48 36\n")
    shutil.copytree(room / "images", folder / "images_2")
    (scene,) = standard_scenes("mipnerf360", tmp_path / "360", ["bonsai"])
    run, work = Cell(**vars(scene), method="bitymi", options=SMALL, seed=3, steps=2), tmp_path / "work"
    run_measured(train_command(work, run), tmp_path / "log")  # its end is in the message if it fails
    (curve,) = read_jsonl(work / run.output / CURVE).curves
    assert curve.scene == "bonsai"
    config, pipeline, _, _ = eval_setup(work / run.output / "config.yml", test_mode="test")
    assert config.machine.seed == config.pipeline.model.train.seed == 3
    assert config.pipeline.datamanager.train_cameras_sampling_seed == 3
    held_out = [name.name for name in pipeline.datamanager.eval_dataset.image_filenames]
    every = sorted(path.name for path in (folder / "images_2").iterdir())
    assert held_out == every[::8]
    camera, batch = pipeline.datamanager.eval_view(0)
    assert batch["image"].shape[:2] == (36, 48) == (int(camera.height), int(camera.width))
