"""Training through nerfstudio's entry point: results, every method, initial points."""

import json
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from bitymi_ns.train import init, strategy, texels
from tests.captures import edit, write_cloud
from tests.e2e.runs import Start, checkpoint, config_of
from tests.typed import Patch, Printed


def test_a_run_leaves_a_configuration_checkpoints_and_a_curve(trained: Run) -> None:
    folder = trained.get_base_dir()
    assert config_of(folder).max_num_iterations == 60
    saved = sorted(p.name for p in trained.get_checkpoint_dir().iterdir())
    assert saved == ["step-000000020.ckpt", "step-000000040.ckpt", "step-000000059.ckpt"]
    points = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert [p["step"] for p in points] == [20, 40, 60]
    assert {"seconds", "cpu_seconds", "surfels", "fragments", "psnr"} <= points[-1].keys()
    assert points[-1]["seconds"] > points[0]["seconds"] > 0
    assert points[-1]["psnr"] > 8
    counts = {len(checkpoint(trained, s)["pipeline"]["_model.scene.surfels.means"]) for s in (20, 40, 59)}
    assert len(counts) > 1


def test_short_runs_start_with_fewer_surfels(room: Path, start: Start, capsys: Printed, monkeypatch: Patch) -> None:
    monkeypatch.setattr(init, "FEWEST_FIRST", 10)
    config = start()
    config.max_num_iterations = 5
    ns_train.main(config)
    said = " ".join(capsys.readouterr().out.split())
    assert "starts from 10 surfels: 190 of 200 points" in said and "train.first-surfels" in said
    resumed = start(name="resumed")
    resumed.max_num_iterations, resumed.load_dir = 8, config.get_checkpoint_dir()
    ns_train.main(resumed)  # which densification may double as before, however many points there are
    for of in ((config, 4), (resumed, 7)):
        assert checkpoint(*of)["pipeline"]["_model._extra_state"]["first_surfels"] == 10


def test_a_run_that_memory_ends_says_so(start: Start, capsys: Printed, monkeypatch: Patch) -> None:
    monkeypatch.setattr(strategy, "room_to_grow", lambda device, processes: 2e5)
    monkeypatch.setattr(texels, "room_to_grow", lambda device, processes: 0.0)
    config = start()
    ns_train.main(config)
    said = " ".join(capsys.readouterr().out.split())
    points = [json.loads(line) for line in (config.get_base_dir() / FILE).read_text().splitlines()]
    most = points[0]["surfels_by_memory"]
    assert said.count(f"Surfels stop growing at {most:,}, as 75% of the memory is used up") == 1
    assert said.count("Texels stop growing at ") == 1 and "Densification stops" not in said
    assert all(point["surfels"] <= most == point["surfels_by_memory"] for point in points)
    assert "texels_by_memory" not in points[0]
    extra = checkpoint(config, 59)["pipeline"]["_model._extra_state"]["run"]
    assert extra["strategy"]["most_by_memory"] == most
    resumed = start(name="resumed")
    resumed.load_dir, resumed.max_num_iterations = config.get_checkpoint_dir(), 70
    ns_train.main(resumed)
    assert checkpoint(resumed, 69)["pipeline"]["_model._extra_state"]["run"]["strategy"]["most_by_memory"] == most


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("pipeline.model.scene.sv_sites", 40, "out of range .*sv_sites must be less than or equal to 32, not 40"),
        ("pipeline.model.train.freeze_every", 0, "out of range .*freeze_every"),
        ("machine.seed", -1, "--machine.seed must be from 0 to 4294967295, not -1"),
    ],
)
def test_options_out_of_range(start: Start, option: str, value: Any, message: str) -> None:
    config, (group, _, name) = start(), option.rpartition(".")
    setattr(attrgetter(group)(config), name, value)
    with pytest.raises(InputError, match=message):
        ns_train.main(config)


@pytest.mark.parametrize(("machine", "of_views", "of_training"), [(42, 42, 0), (7, 7, 7), (7, 5, 3)])
def test_the_machines_seed_is_every_seed(start: Start, machine: int, of_views: int, of_training: int) -> None:
    config = start()
    config.machine.seed, pipeline = machine, config.pipeline
    if machine != of_views:
        pipeline.datamanager.train_cameras_sampling_seed, pipeline.model.train.seed = of_views, of_training
    config.set_timestamp()
    assert (pipeline.datamanager.train_cameras_sampling_seed, pipeline.model.train.seed) == (of_views, of_training)


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


def test_nan_points_are_left_out_and_counted(capture: Path, start: Start, capsys: Printed) -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))
    points[3:8] = np.nan
    write_cloud(capture / "sparse_pc.ply", points)
    config = start(data=capture)
    config.max_num_iterations = 2
    ns_train.main(config)
    out = " ".join(capsys.readouterr().out.split())
    assert "5 of 200 points" in out
    assert "Training will take" in out and "GB of memory for 10 training photographs of 48 x 36" in out
    write_cloud(capture / "sparse_pc.ply", np.full((200, 3), np.nan))
    with pytest.raises(InputError, match="all 200 points .* are NaN"):
        ns_train.main(start(data=capture, name="nan"))


@pytest.mark.slow
@pytest.mark.parametrize("empty", [False, True])
def test_no_points_start_at_random(capture: Path, start: Start, capsys: Printed, empty: bool) -> None:
    if empty:
        write_cloud(capture / "sparse_pc.ply", np.empty((0, 3)))
    else:
        edit(capture, lambda meta: meta.pop("ply_file_path"))
    config = start(data=capture)
    config.max_num_iterations, config.pipeline.model.train.random_points = 2, 300
    ns_train.main(config)
    assert "Surfels are made of 300 random points" in " ".join(capsys.readouterr().out.split())
    config = start(data=capture, name="box")
    config.pipeline.datamanager.dataparser.scene_scale = 0.0
    with pytest.raises(InputError, match="scene box of the capture, .*, is empty. .*--scene-scale"):
        ns_train.main(config)


def test_evaluation_of_batches_while_training(start: Start) -> None:
    config = start(name="batches")
    config.max_num_iterations, config.steps_per_eval_batch = 6, 2
    ns_train.main(config)
    assert config.get_checkpoint_dir().is_dir()
