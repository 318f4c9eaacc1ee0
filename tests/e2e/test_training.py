"""Training through nerfstudio's own entry point: what it leaves behind, resuming, interruption and bad checkpoints."""

from __future__ import annotations

import copy
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.host import run_folder
from bitymi_ns.host.config import BitymiTrainerConfig
from bitymi_ns.host.curve import FILE
from bitymi_ns.host.errors import InputError
from bitymi_ns.host.trainer import BitymiTrainer

Start = Callable[..., BitymiTrainerConfig]


def checkpoint(config: BitymiTrainerConfig, step: int) -> dict[str, Any]:
    return torch.load(config.get_checkpoint_dir() / f"step-{step:09d}.ckpt", weights_only=True)


def different(a: Any, b: Any, path: str = "") -> list[str]:
    """Where two checkpoints differ, clocks left out."""
    if path.endswith("seconds"):
        return []
    if isinstance(a, torch.Tensor):
        return [] if torch.equal(a, b) else [path]
    if isinstance(a, dict):
        if a.keys() != b.keys():
            return [path]
        return [d for key in a for d in different(a[key], b[key], f"{path}/{key}")]
    if isinstance(a, (list, tuple)):
        return [d for i, pair in enumerate(zip(a, b, strict=True)) for d in different(*pair, f"{path}/{i}")]
    return [] if a == b else [path]


def test_a_run_leaves_a_configuration_checkpoints_and_a_curve(trained: BitymiTrainerConfig) -> None:
    folder = trained.get_base_dir()
    assert yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader).max_num_iterations == 60
    saved = sorted(p.name for p in trained.get_checkpoint_dir().iterdir())
    assert saved == ["step-000000020.ckpt", "step-000000040.ckpt", "step-000000059.ckpt"]
    points = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert [p["step"] for p in points] == [20, 40, 60]
    assert {"seconds", "cpu_seconds", "surfels", "fragments", "psnr"} <= points[-1].keys()
    assert points[-1]["seconds"] > points[0]["seconds"] > 0
    assert points[-1]["psnr"] > 8


def test_the_number_of_surfels_changes_in_the_run(trained: BitymiTrainerConfig) -> None:
    counts = {len(checkpoint(trained, s)["pipeline"]["_model.scene.surfels.means"]) for s in (20, 40, 59)}
    assert len(counts) > 1


@pytest.mark.parametrize("by", ["load_checkpoint", "load_dir"])
def test_a_resumed_run_ends_bit_for_bit_like_an_uninterrupted_one(
    trained: BitymiTrainerConfig, start: Start, by: str
) -> None:
    config = start(name="resumed")
    config.max_num_iterations = None  # as long as the interrupted run was to be
    if by == "load_checkpoint":
        config.load_checkpoint = trained.get_checkpoint_dir() / "step-000000020.ckpt"
    else:
        config.load_dir, config.load_step = trained.get_checkpoint_dir(), 20
    ns_train.main(config)
    assert different(checkpoint(trained, 59), checkpoint(config, 59)) == []
    steps = [json.loads(line)["step"] for line in (config.get_base_dir() / FILE).read_text().splitlines()]
    assert steps == [20, 40, 60]  # the first point is that of the interrupted run


def test_a_finished_run_is_not_touched_when_it_is_resumed(trained: BitymiTrainerConfig, start: Start) -> None:
    config = start(name="again")
    config.load_dir = trained.get_checkpoint_dir()
    ns_train.main(config)
    assert not config.get_checkpoint_dir().exists()


def interrupt_at(monkeypatch: pytest.MonkeyPatch, step: int, how: signal.Signals = signal.SIGINT) -> None:
    iterate = BitymiTrainer.train_iteration

    def train_iteration(self: BitymiTrainer, current: int) -> Any:
        if current == step:
            os.kill(os.getpid(), how)
        return iterate(self, current)

    monkeypatch.setattr(BitymiTrainer, "train_iteration", train_iteration)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_saves_what_was_learned_and_says_how_to_go_on(
    trained: BitymiTrainerConfig,
    start: Start,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    how: signal.Signals,
) -> None:
    config = start(name="interrupted")
    handler = signal.getsignal(how)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 27, how)
        with pytest.raises(SystemExit) as stop:
            ns_train.main(config)
    assert stop.value.code == 130
    assert signal.getsignal(how) is handler
    assert "--load-dir" in capsys.readouterr().out
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000027.ckpt"]
    resumed = start(name="resumed")
    resumed.load_dir = config.get_checkpoint_dir()
    ns_train.main(resumed)
    assert different(checkpoint(trained, 59), checkpoint(resumed, 59)) == []


def test_a_full_disk_keeps_the_earlier_checkpoint(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    config = start(name="full")
    save = torch.save

    def full_after_the_first(state: Any, file: Any) -> None:
        if isinstance(state, dict) and state.get("step", 0) > 20:
            file.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        save(state, file)

    monkeypatch.setattr(torch, "save", full_after_the_first)
    with pytest.raises(InputError, match="could not be written: the disk is full(.|\n)*Resume with --load-dir"):
        ns_train.main(config)
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000020.ckpt"]
    assert not [p for p in config.get_base_dir().iterdir() if "unfinished" in p.name]
    assert checkpoint(config, 20)["step"] == 20


HOLDS = """
import sys
from pathlib import Path
from bitymi_ns.host import run_folder

run_folder.take(Path(sys.argv[1]))
print("has it", flush=True)
sys.stdin.read()
"""


def test_a_folder_takes_one_run_at_a_time(start: Start) -> None:
    config = start(name="run")
    config.max_num_iterations = 2
    folder = config.get_base_dir()
    other = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout is not None and other.stdout.readline() == "has it\n"
        with pytest.raises(InputError, match=f"is in use: process {other.pid} is at work(.|\n)*--timestamp") as stop:
            ns_train.main(copy.deepcopy(config))
        assert stop.value.code != 0 and [p.name for p in folder.iterdir()] == [".lock"]  # nothing of it is touched
    finally:
        other.kill()
        other.communicate()
    (folder / ".step-000000001.ckpt.unfinished").write_text("of the run that was killed")
    ns_train.main(config)
    assert not [p.name for p in folder.iterdir() if p.name.startswith(".")]
    again = start(name="run")  # into the same folder, once the first has ended
    again.max_num_iterations, again.load_dir = 3, config.get_checkpoint_dir()
    ns_train.main(again)
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000002.ckpt"]


def test_resuming_in_another_folder_cleans_up_the_one_of_the_killed_run(
    trained: BitymiTrainerConfig, start: Start, tmp_path: Path
) -> None:
    killed = a_run_of(trained, tmp_path)
    (killed / ".step-000000060.ckpt.unfinished").write_text("half")
    config = start(name="resumed")
    config.load_dir = killed / "nerfstudio_models"
    ns_train.main(config)
    assert not [p.name for p in killed.iterdir() if p.name.startswith(".")]


def test_too_little_room_for_a_checkpoint_is_found_first(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder.files, "free_bytes", lambda path: 12_000)
    config = start(name="full")
    with pytest.raises(InputError, match=r"has 12.0 kB free, and a checkpoint takes [\d.]+ [kM]B already at the start"):
        ns_train.main(config)
    assert not (config.get_base_dir() / "nerfstudio_models").exists()


def test_a_folder_that_cannot_be_written(start: Start) -> None:
    config = start(name="readonly")
    config.output_dir = config.output_dir / "file"
    config.output_dir.parent.mkdir()
    config.output_dir.write_text("in the way")
    with pytest.raises(InputError, match="cannot be written: .*is not a folder.*--output-dir"):
        ns_train.main(config)


def test_ctrl_c_while_the_capture_is_read(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    config = start(name="early")
    monkeypatch.setattr(type(config.pipeline), "setup", interrupted)
    with pytest.raises(SystemExit) as stop:
        ns_train.main(config)
    assert stop.value.code == 130


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


def test_a_checkpoint_of_another_preset(trained: BitymiTrainerConfig, start: Start) -> None:
    config = start(method="bitymi-sh")
    config.load_dir = trained.get_checkpoint_dir()
    with pytest.raises(InputError, match="another preset:\n.*view-color: sv there, sh here"):
        ns_train.main(config)


def test_checkpoints_that_are_missing_or_damaged(trained: BitymiTrainerConfig, start: Start, tmp_path: Path) -> None:
    config = start()
    config.load_dir = tmp_path / "nowhere"
    with pytest.raises(InputError, match="there is no checkpoint folder"):
        ns_train.main(copy.deepcopy(config))
    config.load_dir.mkdir()
    with pytest.raises(InputError, match="holds no checkpoint"):
        ns_train.main(copy.deepcopy(config))
    whole = (trained.get_checkpoint_dir() / "step-000000059.ckpt").read_bytes()
    (config.load_dir / "step-000000059.ckpt").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        ns_train.main(copy.deepcopy(config))


def test_optimisers_of_another_scene(trained: BitymiTrainerConfig, start: Start, tmp_path: Path) -> None:
    state = checkpoint(trained, 59)
    del state["optimizers"]["means"]["param_groups"]
    torch.save(state, tmp_path / "step-000000059.ckpt")
    config = start()
    config.load_dir = tmp_path
    with pytest.raises(InputError, match="step-000000059.ckpt cannot be resumed"):
        ns_train.main(config)


def a_run_of(trained: BitymiTrainerConfig, folder: Path) -> Path:
    """A copy of the run, in another place: its folder."""
    return Path(shutil.copytree(trained.get_base_dir(), folder / "run"))


def rewrite(folder: Path, change: Callable[[BitymiTrainerConfig], None]) -> None:
    """Apply `change` to the config.yml of a run."""
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    change(config)
    (folder / "config.yml").write_text(yaml.dump(config))


def test_evaluation_refuses_a_checkpoint_that_is_damaged_or_missing(
    trained: BitymiTrainerConfig, tmp_path: Path
) -> None:
    folder = a_run_of(trained, tmp_path)
    newest = folder / "nerfstudio_models" / "step-000000059.ckpt"
    newest.write_bytes(newest.read_bytes()[:1000])
    with pytest.raises(InputError, match=f"{newest} is damaged(.|\n)*go back to step-000000040.ckpt"):
        eval_setup(folder / "config.yml")
    newest.unlink()
    assert eval_setup(folder / "config.yml")[3] == 40
    shutil.rmtree(newest.parent)
    newest.parent.mkdir()
    with pytest.raises(InputError, match="holds no checkpoint"):
        eval_setup(folder / "config.yml")


def test_evaluation_refuses_a_checkpoint_of_another_preset(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    folder = a_run_of(trained, tmp_path)
    rewrite(folder, lambda config: setattr(config.pipeline.model.scene, "view_color", "sg"))
    with pytest.raises(InputError, match="another preset:\n.*view-color: sv there, sg here"):
        eval_setup(folder / "config.yml")


def test_evaluation_of_a_resumed_run_takes_its_own_checkpoint(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    folder = a_run_of(trained, tmp_path)
    rewrite(folder, lambda config: setattr(config, "load_step", 7))  # of the run that it went on from
    assert eval_setup(folder / "config.yml")[3] == 59


def test_the_near_plane_is_the_one_of_the_training(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    scene = eval_setup(trained.get_base_dir() / "config.yml")[1].model.scene
    assert 0.02 < scene.near < 0.04  # nerfstudio scales the cameras to 1
    folder = a_run_of(trained, tmp_path)
    path = max((folder / "nerfstudio_models").iterdir())
    state = torch.load(path, weights_only=True)
    state["pipeline"]["_model._extra_state"]["near"] = 0.5
    torch.save(state, path)
    assert eval_setup(folder / "config.yml")[1].model.scene.near == 0.5
    rewrite(folder, lambda config: setattr(config.pipeline.model.scene, "near", 0.1))
    assert eval_setup(folder / "config.yml")[1].model.scene.near == 0.1


@pytest.mark.parametrize(
    "method", ["bitymi-quality", "bitymi-fast", "bitymi-sh", "bitymi-sb", "bitymi-sg", "bitymi-notexture"]
)
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
    assert "starts from 300 random ones" in " ".join(capsys.readouterr().out.split())


def test_no_points_and_an_empty_scene_box(room: Path, start: Start, tmp_path: Path) -> None:
    config = start(data=without_points(room, tmp_path))
    config.pipeline.datamanager.dataparser.scene_scale = 0.0
    with pytest.raises(InputError, match="scene box of the capture, .*, is empty. .*--scene-scale"):
        ns_train.main(config)


def test_a_new_run_keeps_out_of_the_folder_of_an_earlier_one(trained: BitymiTrainerConfig, start: Start) -> None:
    config = start(name="run")
    config.output_dir = trained.output_dir
    with pytest.raises(
        InputError, match="holds a run already, its newest checkpoint is step-000000059.ckpt.*--load-dir"
    ):
        ns_train.main(config)
    assert len(list(trained.get_checkpoint_dir().glob("*.ckpt"))) == 3


def test_a_run_that_branches_off_earlier_keeps_the_later_checkpoints(
    trained: BitymiTrainerConfig, start: Start, tmp_path: Path
) -> None:
    config = start(name="branch")
    shutil.copytree(trained.get_checkpoint_dir(), config.get_checkpoint_dir())
    config.load_dir, config.load_step, config.max_num_iterations = config.get_checkpoint_dir(), 20, 41
    config.steps_per_save = 100
    ns_train.main(config)
    assert [p.name for p in sorted(config.get_checkpoint_dir().iterdir())] == [
        "step-000000040.ckpt", "step-000000059.ckpt"
    ]  # fmt: skip


def test_going_on_with_another_capture_is_said(
    trained: BitymiTrainerConfig, room: Path, start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def resumed(change: Callable[[dict[str, Any]], None], name: str) -> str:
        data = tmp_path / name
        shutil.copytree(room, data)
        meta = json.loads((data / "transforms.json").read_text())
        change(meta)
        (data / "transforms.json").write_text(json.dumps(meta))
        config = start(name=name, data=data)
        config.load_dir, config.load_step, config.max_num_iterations = trained.get_checkpoint_dir(), 59, 61
        capsys.readouterr()
        ns_train.main(config)
        return " ".join(capsys.readouterr().out.split())

    def moved(meta: dict[str, Any]) -> None:
        meta["frames"][3]["transform_matrix"][0][3] += 0.5

    assert "another capture" not in resumed(lambda meta: None, "same")
    assert "it had 10 training photographs, this one has 9" in resumed(lambda meta: meta["frames"].pop(), "fewer")
    assert "its cameras stand elsewhere" in resumed(moved, "moved")


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
