"""Poses in another convention than their file's, detected by the capture's points."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.points import read_points
from tests.captures import edit_frames, load_any, printed, write_cloud
from tests.formats import colmap

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
Pose = np.ndarray
WRONG = "As they are, the scene will be wrong."


@pytest.fixture
def model(capture: Path) -> Path:
    """images.txt of the room as a COLMAP model with 200 points."""
    points = read_points(capture / "sparse_pc.ply")[0]
    folder = colmap(capture)
    rows = [" ".join(map(str, [i, *xyz, *rgb, 0.5])) for i, (xyz, rgb) in enumerate(zip(*points, strict=True), 1)]
    (folder / "points3D.txt").write_text("\n".join(rows))
    return folder / "images.txt"


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (lambda pose: pose @ FLIP, "the cameras have OpenCV's axes"),
        (np.linalg.inv, "they are world to camera: invert them."),
        (lambda pose: np.linalg.inv(pose @ FLIP), "they are world to camera with OpenCV's axes"),
        (lambda pose: pose @ np.diag([1.0, 1.0, -1.0, 1.0]), "they are left-handed, as Unity's"),
    ],
)
def test_of_a_transforms_json(
    capture: Path, written: Callable[[Pose], Pose], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    edit_frames(capture, lambda f: f.update(transform_matrix=written(np.array(f["transform_matrix"])).tolist()))
    load_any(capture)
    text = printed(capsys)
    assert f"another convention: {message}" in text and WRONG in text


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (lambda w2c: FLIP @ w2c, "the cameras have OpenGL's axes"),
        (np.linalg.inv, "they are camera to world: invert them."),
        (lambda w2c: np.linalg.inv(FLIP @ w2c), "they are camera to world with OpenGL's axes"),
        (None, "the quaternions are in the order x, y, z, w"),
    ],
)
def test_of_a_colmap_model(
    model: Path, written: Callable[[Pose], Pose] | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = []
    for line in filter(None, model.read_text().splitlines()):
        number, *pose, camera, name = line.split()
        pose = list(map(float, pose))
        if written is None:
            pose[:4] = [*pose[1:4], pose[0]]
        else:
            w2c = np.eye(4)
            w2c[:3, :3], w2c[:3, 3] = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix(), pose[4:]
            other = written(w2c)
            x, y, z, w = Rotation.from_matrix(other[:3, :3]).as_quat()
            pose = [w, x, y, z, *other[:3, 3]]
        lines.append(f"{' '.join(map(str, [number, *pose, camera, name]))}\n\n")
    model.write_text("".join(lines))
    load_any(model.parents[2])
    text = printed(capsys)
    assert f"another convention: {message}" in text and WRONG in text


@pytest.mark.parametrize("colours", [True, False])
def test_right_ones_are_nothing_to_speak_of(capture: Path, colours: bool, capsys: pytest.CaptureFixture[str]) -> None:
    if not colours:
        write_cloud(capture / "sparse_pc.ply", read_points(capture / "sparse_pc.ply")[0].xyz, None)
    load_any(capture)
    assert "convention" not in printed(capsys)


def test_right_ones_of_a_colmap_model(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load_any(model.parents[2])
    assert "convention" not in printed(capsys)
