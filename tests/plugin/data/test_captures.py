"""What the data manager makes of captures, good and bad."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from PIL import Image

from bitymi_ns.plugin.run.model import train_config_for
from bitymi_ns.train.config import TrainConfig
from tests.plugin.data.captures import expect, images_of, load, load_with


def test_every_eighth_image_is_held_out_and_cached_without_cuda(capture: Path) -> None:
    manager = load(capture)
    assert (len(manager.train_dataset), len(manager.eval_dataset)) == (10, 2)
    manager.config.cache_images = "cpu"
    image = manager.cached_train[0]["image"]
    assert image.shape == (36, 48, 3) and image.dtype == torch.uint8


def test_the_order_of_views_depends_on_seed_and_step_alone(capture: Path) -> None:
    manager, other = load(capture), load(capture)
    order = [manager.train_index(step) for step in range(25)]
    assert order[10:20] == [other.train_index(step) for step in range(10, 20)]  # as after a resume
    assert sorted(order[:10]) == list(range(10)) == sorted(order[10:20])
    assert order[:10] != order[10:20]
    other.config.train_cameras_sampling_seed += 1
    assert order != [other.train_index(step) for step in range(25)]


def test_views_for_scoring_leave_the_order_alone(capture: Path) -> None:
    manager = load(capture)
    first = manager.next_train(3)[1]["image_idx"]
    for index in range(5):
        manager.train_view(index)
    assert manager.next_train(3)[1]["image_idx"] == first


def test_a_batch_does_not_share_its_dictionary_with_the_cache(capture: Path) -> None:
    manager = load(capture)
    manager.train_view(0)[1]["image"] = None
    assert manager.cached_train[0]["image"] is not None


def test_alpha_is_kept_for_the_model(capture: Path) -> None:
    for path in images_of(capture):
        image = Image.open(path).convert("RGBA")
        image.putpixel((0, 0), (0, 0, 0, 0))
        image.save(path.with_suffix(".png"))
    manager = load(capture)
    assert manager.train_dataset.metadata["has_alpha"] is True
    assert manager.train_dataset.metadata["transparent"] is True
    assert manager.cached_train[0]["image"].shape[-1] == 4
    assert manager.train_dataset[0]["image"].shape[-1] == 3  # what viewer and ns-render show


def test_an_alpha_channel_without_a_transparent_pixel_is_none(capture: Path) -> None:
    for path in images_of(capture):
        Image.open(path).convert("RGBA").save(path.with_suffix(".png"))
    manager = load(capture)
    assert manager.train_dataset.metadata["transparent"] is False
    assert manager.cached_train[0]["image"].shape[-1] == 3
    opaque = images_of(capture)[0]
    for path in images_of(capture)[1:]:
        image = Image.open(path).convert("RGBA")
        image.putpixel((0, 0), (0, 0, 0, 0))
        image.save(path.with_suffix(".png"))
    assert opaque.exists() and load(capture).train_dataset.metadata["transparent"] is True


def test_the_colour_behind_transparent_photographs() -> None:
    """What the capture states stands for any one colour, as in runs before there was another choice."""
    white = torch.ones(3)
    for given, transparent, wanted in (
        ("auto", True, "auto"), ("auto", False, "white"), ("random", True, "random"), ("black", True, "white")
    ):  # fmt: skip
        made = train_config_for(TrainConfig(background=given), white, transparent)  # type: ignore[arg-type]
        assert (made.background, made.alpha_color) == (wanted, "white")
    assert train_config_for(TrainConfig(background="white"), None, True).background == "white"
    assert train_config_for(TrainConfig(), None, True).background == "auto"
    assert train_config_for(TrainConfig(), None, False).background == "black"


def test_a_box_counts_only_where_the_capture_declares_one(capture: Path, edit: Any) -> None:
    assert load(capture).train_dataset.metadata["declares_box"] is False  # nerfstudio's default box
    for declared in (False, True):
        if declared:
            edit(capture, lambda meta: meta.update(aabb_scale=2))
        manager = load_with(capture, InstantNGPDataParserConfig(eval_mode="interval"))
        assert manager.train_dataset.metadata["declares_box"] is declared
    assert manager.train_dataset.scene_box.aabb.tolist() == [[-1.0] * 3, [1.0] * 3]


def test_masks_are_loaded(capture: Path, edit: Any) -> None:
    (capture / "masks").mkdir()

    def add_masks(meta: dict) -> None:
        for frame in meta["frames"]:
            name = "masks/" + Path(frame["file_path"]).stem + ".png"
            Image.fromarray(np.tile(np.uint8([[0, 255]]), (36, 24))).save(capture / name)
            frame["mask_path"] = name

    edit(capture, add_masks)
    mask = load(capture).cached_train[0]["mask"]
    assert mask.dtype == torch.bool and mask.shape == (36, 48, 1) and 0.4 < mask.float().mean() < 0.6


def test_undistorted_cameras_are_marked_as_such(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.update(k1=0.05))
    manager = load(capture)
    assert float(manager.undistorted_train_cameras().distortion_params.abs().max()) == 0.0
    assert manager.cached_train[0]["image"].shape[1] == int(manager.train_cameras.width[0])


def test_a_missing_folder(tmp_path: Path) -> None:
    with expect(r"capture .*nowhere does not exist"):
        load(tmp_path / "nowhere")


def test_an_empty_folder(tmp_path: Path) -> None:
    with expect("is empty.*ns-process-data"):
        load(tmp_path)


def test_a_folder_without_transforms(capture: Path) -> None:
    (capture / "transforms.json").unlink()
    with expect("holds no transforms.json"):
        load(capture)


def test_broken_json(capture: Path) -> None:
    (capture / "transforms.json").write_text("{")
    with expect("cannot be read"):
        load(capture)


def test_no_frames(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.update(frames=[]))
    with expect("lists no frames"):
        load(capture)


def test_a_frame_without_pose(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta["frames"][2].pop("transform_matrix"))
    with expect("frame 2 .counted from 0. has no transform_matrix. Add that or remove the frame"):
        load(capture)


def test_intrinsics_missing(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: [meta.pop(key, None) for key in ("fl_x", "fl_y")])
    with expect("gives no fl_x for images/frame_00001.png, .* and 9 more: .*Add it once at the top of the file"):
        load(capture)


def test_a_reader_of_nerfstudios_that_lacks_a_library(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with expect("reader of this capture cannot be loaded: .*open3d"):
        load(capture)


def test_poses_without_images(capture: Path) -> None:
    for path in images_of(capture)[3:6]:
        path.unlink()
    with expect("3 of 12 images of the capture are missing"):
        load(capture)


def test_no_images_at_all(capture: Path) -> None:
    for path in images_of(capture):
        path.unlink()
    with expect("12 of 12 images of the capture are missing"):
        load(capture)


@pytest.mark.parametrize("pose", [[[float("nan")] * 4] * 4, [[1, 0], [0, 1]], "here"])
def test_a_pose_that_is_none(capture: Path, edit: Any, pose: Any) -> None:
    edit(capture, lambda meta: meta["frames"][3].update(transform_matrix=pose))
    with expect("transform_matrix of images/frame_00004.png is not a matrix of 4 x 4 finite numbers"):
        load(capture)


def test_all_cameras_at_one_place(capture: Path, edit: Any) -> None:
    first = json.loads((capture / "transforms.json").read_text())["frames"][0]["transform_matrix"]
    edit(capture, lambda meta: [frame.update(transform_matrix=first) for frame in meta["frames"]])
    with expect("all cameras are at one place"):
        load(capture)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("fl_x", -30.0, "frame_00002.png cannot be used: its focal lengths are not positive"),
        ("fl_y", float("inf"), "its focal lengths are not positive and finite"),
        ("cx", float("nan"), "its principal point is not finite"),
        ("w", 0, "its image size is not positive"),
    ],
)
def test_cameras_through_which_nothing_is_seen(capture: Path, edit: Any, key: str, value: float, message: str) -> None:
    edit(capture, lambda meta: meta.update({key: value}))
    with expect(message):
        load(capture)


def test_an_image_of_another_size_is_named(capture: Path) -> None:
    path = images_of(capture)[4]
    Image.open(path).resize((40, 30)).save(path)
    with expect(f"{path.name} has 40 x 30 pixels, but its camera is for 48 x 36"):
        _ = load(capture).cached_train


def test_a_damaged_image_is_named(capture: Path) -> None:
    path = images_of(capture)[4]
    path.write_bytes(path.read_bytes()[:40])
    with expect(f"{path.name} cannot be read"):
        _ = load(capture).cached_train


def test_one_view(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.update(frames=meta["frames"][:2]))
    with expect("only one training view"):
        load(capture)  # the other is held out
    edit(capture, lambda meta: meta.update(frames=meta["frames"][:1]))
    with expect("has one image only"):
        load(capture)


def test_few_views_work_with_a_warning(capture: Path, edit: Any, capsys: pytest.CaptureFixture[str]) -> None:
    edit(capture, lambda meta: meta.update(frames=meta["frames"][:5]))
    assert len(load(capture).train_dataset) == 4
    assert "Only 4 training views" in capsys.readouterr().out


def test_a_point_cloud_that_is_not_there(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.update(ply_file_path="gone.ply"))
    with expect("point cloud .*gone.ply does not exist.*remove ply_file_path"):
        load(capture)


def test_a_point_cloud_that_is_cut_off(capture: Path) -> None:
    cloud = capture / "sparse_pc.ply"
    whole = cloud.read_bytes()
    cloud.write_bytes(whole[: len(whole) // 2])
    with expect("sparse_pc.ply is cut off: it has .* of 200 points"):
        load(capture)
    cloud.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with expect("sparse_pc.ply is not a PLY file"):
        load(capture)


def test_colmap_points_do_not_stop_a_run_without_terminal(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.pop("ply_file_path"))
    (capture / "colmap/sparse/0").mkdir(parents=True)
    manager = load(capture)  # nerfstudio would wait for an answer
    assert "points3D_xyz" not in manager.train_dataparser_outputs.metadata


def test_the_transforms_file_may_be_named_itself(capture: Path) -> None:
    assert json.loads((capture / "transforms.json").read_text())["frames"]
    assert len(load(capture / "transforms.json").train_dataset) == 10


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale_factor": 0.0}, "--scale-factor is 0.0, but has to be above 0"),
        ({"scale_factor": -1.0}, "--scale-factor is -1.0, but has to be above 0"),
        ({"downscale_factor": 0}, "--downscale-factor is 0, but has to be 1 or more"),
        ({"eval_mode": "fraction", "train_split_fraction": 2.0}, "--train-split-fraction is 2.0, .* at most 1"),
        ({"eval_interval": 0}, "--eval-interval is 0, but has to be 1 or more"),
    ],
)
def test_options_that_leave_no_capture(capture: Path, options: dict[str, Any], message: str) -> None:
    with expect(message):
        load(capture, **options)


def test_options_that_nothing_reads_are_not_looked_at(capture: Path) -> None:
    assert len(load(capture, eval_mode="interval", train_split_fraction=2.0).train_dataset) == 10
