"""Poses that are not rotations, and cameras far from the others."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.pose_checks import check_outliers, check_point_unit, rotations
from tests.captures import edit, edit_frames, expect, load, load_with, printed, write_cloud


def pose_of(frame: dict[str, Any]) -> np.ndarray:
    return np.array(frame["transform_matrix"])


def change_poses(capture: Path, change: Any, only: int | None = None) -> None:
    """Apply `change` to the 3 x 3 parts of all poses, or of one."""

    def apply(meta: dict[str, Any]) -> None:
        for frame in meta["frames"] if only is None else [meta["frames"][only]]:
            pose = pose_of(frame)
            pose[:3, :3] = change(pose[:3, :3])
            frame["transform_matrix"] = pose.tolist()

    edit(capture, apply)


@pytest.mark.parametrize("only", [None, 3])
@pytest.mark.parametrize("center", ["poses", "focus"])
def test_scaled_rotations_give_the_cameras_of_clean_ones(
    capture: Path, capsys: pytest.CaptureFixture[str], only: int | None, center: str
) -> None:
    clean = load(capture, center_method=center)
    change_poses(capture, lambda part: 2.5 * part, only)
    capsys.readouterr()
    scaled = load(capture, center_method=center)
    assert torch.allclose(
        scaled.train_dataset.cameras.camera_to_worlds, clean.train_dataset.cameras.camera_to_worlds, atol=1e-6
    )
    points = [m.train_dataparser_outputs.metadata["points3D_xyz"] for m in (scaled, clean)]
    assert torch.allclose(*points, atol=1e-6)
    message = printed(capsys)
    assert message.count("scaled by 2.5 in the poses of") == 1 and "positions stay as they are" in message
    assert ("in the poses of images/frame_00004.png. The" in message) == (only is not None)


def test_rounded_matrices_are_taken(capsys: pytest.CaptureFixture[str]) -> None:
    exact = Rotation.random(50, random_state=0).as_matrix()
    names = list(range(50))
    four = exact.round(4)
    assert np.array_equal(rotations(four, names, "here"), four) and printed(capsys) == ""
    two = rotations(exact.round(2), names, "here")
    assert np.abs(two @ two.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12 and np.abs(two - exact).max() < 0.01
    assert "here: rotations are off by up to 0.01 in the poses of 3, 6, 9" in printed(capsys)
    single = exact.astype(np.float32).astype(np.float64)
    assert np.array_equal(rotations(single, names, "here"), single)


def test_a_mirrored_capture_is_taken_and_a_mirrored_frame_is_named(
    capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change_poses(capture, lambda part: part * [-1, 1, 1])
    c2w = load(capture).train_dataset.cameras.camera_to_worlds
    assert (torch.linalg.det(c2w[:, :, :3]) < 0).all() and "mirrored against the other" not in printed(capsys)
    change_poses(capture, lambda part: part * [-1, 1, 1], only=3)
    load(capture)
    assert "images/frame_00004.png is mirrored against the other frames" in (message := printed(capsys))
    assert message.count("mirrored against") == 1


def test_three_rows_are_enough(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = load(capture).train_dataset.cameras.camera_to_worlds
    edit_frames(capture, lambda frame: frame.update(transform_matrix=frame["transform_matrix"][:3]))
    assert torch.equal(load(capture).train_dataset.cameras.camera_to_worlds, clean)
    edit_frames(
        capture, lambda f: f.update(transform_matrix=(np.array([*f["transform_matrix"], [0, 0, 0, 1]]) / 8).tolist())
    )
    assert torch.equal(load(capture).train_dataset.cameras.camera_to_worlds, clean)
    assert "is divided by its last number, which is not 1" in printed(capsys)
    edit_frames(capture, lambda frame: frame.update(transform_matrix=np.array(frame["transform_matrix"]).T.tolist()))
    with expect("last row of the transform_matrix of images/frame_00001.png is .* not 0 0 0 1.*has to be transposed"):
        load(capture)


def blender(capture: Path, scale: float = 1.0, shear: float = 0.0, **common: Any) -> None:
    """Write the capture in Blender's format; `common`: entries of each file."""
    meta = json.loads((capture / "transforms.json").read_text())
    frames = []
    for i, frame in enumerate(meta["frames"]):
        pose = pose_of(frame)
        pose[:3, :3] *= scale
        pose[:3, 0] += (i == 0) * shear * pose[:3, 1]
        frames.append({"file_path": frame["file_path"][:-4], "transform_matrix": pose.tolist()})
    for split, some in (("train", frames[:9]), ("val", frames[9:])):
        more = common.get(split) or ({} if {"train", "val"} & common.keys() else common)
        text = json.dumps({"camera_angle_x": 1.1, "frames": some, **more})
        (capture / f"transforms_{split}.json").write_text(text, "utf-8-sig")


def test_blenders_and_instant_ngps_poses_are_checked_as_well(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blender(capture, 1.0, 0.0)
    clean = load_with(capture, BlenderDataParserConfig()).train_dataset.cameras.camera_to_worlds
    blender(capture, 2.5, 0.0)
    scaled = load_with(capture, BlenderDataParserConfig()).train_dataset.cameras.camera_to_worlds
    assert torch.allclose(scaled, clean, atol=1e-6) and "scaled by 2.5" in printed(capsys)
    blender(capture, 1.0, 0.3)
    with expect("transforms_train.json: the 3 x 3 part of the pose of images/frame_00001 is no rotation"):
        load_with(capture, BlenderDataParserConfig())
    ngp = InstantNGPDataParserConfig(eval_mode="interval")
    clean = load_with(capture, ngp).train_dataset.cameras.camera_to_worlds
    change_poses(capture, lambda part: 0.4 * part)
    assert torch.allclose(load_with(capture, ngp).train_dataset.cameras.camera_to_worlds, clean, atol=1e-6)


@pytest.mark.parametrize(
    ("common", "message"),
    [
        ({"camera_angle_x": 39.6}, r"train.json: camera_angle_x is 39.6.*not degrees \(39.6 deg.* 0.69115\)"),
        ({"camera_angle_x": True}, "camera_angle_x for all frames is True, which is no number"),
        ({"camera_angle_x": 3.14159}, "focal length of .*_00001.png.*span 180 degrees.*camera_angle_x is in radia"),
        ({"frames": None}, "transforms_train.json lists no frames"),
        ({"train": {"frames": []}}, "transforms_train.json lists no frames"),
        ({"val": {"frames": []}}, "transforms_val.json lists no frames.*move a few frames there"),
    ],
)
def test_blenders_files_that_cannot_be_used(capture: Path, common: dict[str, Any], message: str) -> None:
    blender(capture, **common)
    with expect(message):
        load_with(capture, BlenderDataParserConfig())


def test_a_camera_far_from_all_others(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def place(x: float) -> None:
        edit(capture, lambda meta: meta["frames"][3]["transform_matrix"][0].__setitem__(3, x))

    place(1e6)
    with expect(r"the camera of .*frame_00004.png is [\d,]* times as far .*Correct the pose or remove the frame"):
        load(capture)
    place(500.0)
    load(capture)
    assert "The camera of" in (warning := printed(capsys)) and "If that is a mistake" in warning
    place(50.0)
    load(capture)
    assert "times as far" not in printed(capsys)


def test_groups_of_cameras_are_neither_a_mistake_nor_another_unit(capsys: pytest.CaptureFixture[str]) -> None:
    generator = np.random.default_rng(0)
    tripod, walk = 1e-4 * generator.normal(size=(30, 3)), 5.0 + generator.normal(size=(10, 3))
    check_outliers(np.concatenate([tripod, walk]), list(range(40)))
    check_outliers(np.zeros((5, 3)), list(range(5)))
    points, tripod, walk = (generator.normal(size=(n, 3)) for n in (200, 30, 10))
    check_point_unit(points, np.concatenate([1e-4 * tripod, 2.0 + walk]), np.ones(40))
    check_point_unit(points[:0], tripod, np.ones(30))
    check_point_unit(np.zeros((9, 3)), tripod, np.ones(30))
    assert printed(capsys) == ""


@pytest.mark.parametrize(
    ("factor", "message"),
    [(1.0, ""), (1000.0, "far beyond the cameras"), (0.001, "in a spot of the pictures")],
)
def test_a_cloud_in_another_unit(
    capture: Path, capsys: pytest.CaptureFixture[str], factor: float, message: str
) -> None:
    points = np.random.default_rng(0).normal(size=(500, 3)) * factor
    points[0], points[1] = np.nan, 1e9  # outliers
    write_cloud(capture / "sparse_pc.ply", points, None)
    load(capture)
    warning = printed(capsys)
    assert ("The point cloud seems to be in another unit than the poses" in warning) == bool(message)
    assert message in warning
