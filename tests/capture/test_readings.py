"""Poses are read as the photographs show."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bitymi_ns.capture import readings
from bitymi_ns.capture.readings import (
    CAMERA_AXES,
    INTRINSICS,
    MIRROR,
    SWAPPED,
    TURNS,
    Reading,
    as_meant,
    camera_as,
    decide,
    read_as,
)
from bitymi_ns.capture.types import OPENCV_AXES, ColmapCamera, Photograph
from bitymi_ns.sample.capture import FOCAL, RoomView
from tests.capture.conftest import SIZE
from tests.captures import refused

QUARTER = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
COLMAP = Reading("opencv", "w2c", "wxyz")
JSON = Reading()
SCANNER = Reading(order="xyzw")


@pytest.fixture(scope="session")
def photographs(arc: Path, views: Sequence[RoomView]) -> list[Photograph]:
    files = [arc / f"photo_{i + 1}.png" for i in range(len(views))]
    camera = ColmapCamera("PINHOLE", *SIZE, (FOCAL * SIZE[0], FOCAL * SIZE[0], SIZE[0] / 2, SIZE[1] / 2))
    return [Photograph(file, camera, view.camera_to_world, "") for file, view in zip(files, views, strict=True)]


@pytest.fixture(scope="session")
def pairs(photographs: list[Photograph]) -> list[readings.Pair]:
    return readings.match_pairs(photographs)


@pytest.fixture
def matched(pairs: list[readings.Pair], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readings, "match_pairs", lambda photographs: pairs)


def explained(pairs: list[readings.Pair], photographs: list[Photograph], poses: np.ndarray | None = None) -> int:
    rays = readings.rays_of(pairs, [each.camera for each in photographs])
    return int(readings.explained(pairs, rays, poses).sum())


def poses_of(photographs: Sequence[Photograph]) -> np.ndarray:
    return np.stack([each.pose for each in photographs])


def test_matches_need_no_poses(photographs: list[Photograph], pairs: list[readings.Pair]) -> None:
    """Matches are many, of near and wide pairs, and poses explain nearly all that the pairs' own explain."""
    assert len(pairs) >= 10 and {pair.second - pair.first > 2 for pair in pairs} == {False, True}
    own, total = explained(pairs, photographs), sum(len(pair.x) for pair in pairs)
    assert own >= 300 and own > 0.75 * total
    assert explained(pairs, photographs, poses_of(photographs)) > 0.9 * own
    still = np.tile(photographs[0].pose, (len(photographs), 1, 1))
    assert explained(pairs, photographs, still) == 0, "cameras at one place explain nothing"


def misread(right: np.ndarray, own: Reading, meant: Reading) -> np.ndarray:
    """Write poses in the convention of a reading, and read the file in the format's own."""
    poses = right @ np.linalg.matrix_power(QUARTER, -TURNS[meant.turn] // 90)
    poses = MIRROR @ poses @ MIRROR if meant.axes == "left-handed" else poses @ CAMERA_AXES[meant.axes]
    poses = np.linalg.inv(poses) if meant.direction == "w2c" else poses
    if own.order:
        columns = {"xyzw": [0, 1, 2, 3], "wxyz": [3, 0, 1, 2]}
        numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, columns[meant.order]]
        poses[:, :3, :3] = Rotation.from_quat(numbers[:, np.argsort(columns[own.order])]).as_matrix()
    poses = np.linalg.inv(poses) if own.direction == "w2c" else poses
    return poses @ CAMERA_AXES[own.axes]


@pytest.mark.usefixtures("matched")
@pytest.mark.parametrize("convention", [JSON, COLMAP, SCANNER])
def test_every_misreading_is_found(convention: Reading, photographs: list[Photograph]) -> None:
    right = poses_of(photographs)
    for reading in readings.readings(convention):
        if not reading.intrinsics and (convention is JSON or not reading.turn):
            wrong = misread(right, convention, reading)
            assert decide(photographs, wrong, convention).reading == reading
            meant, mirror = read_as(wrong, convention, reading)
            assert (np.linalg.det(mirror) < 0.0) == (reading.axes == "left-handed")
            np.testing.assert_allclose(meant, right, atol=1e-9)


def test_a_mirrored_camera_leaves_the_world(photographs: list[Photograph]) -> None:
    """Camera axes alone may be left-handed: the determinant is negative."""
    right = poses_of(photographs)
    meant, mirror = read_as(right @ MIRROR, JSON, Reading("left-handed"))
    assert (mirror == np.eye(4)).all()
    np.testing.assert_allclose(meant, right, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*INTRINSICS, SWAPPED])
def test_intrinsics_of_other_pictures(kind: str, photographs: list[Photograph], reported: list[str]) -> None:
    camera = photographs[0].camera
    undo = SWAPPED if kind == SWAPPED else f"intrinsics{1 / INTRINSICS[kind]:g}"
    given = [replace(each, camera=camera_as(camera, undo)) for each in photographs]
    meant, _, name = as_meant(given, JSON, np.eye(4), "transforms.json", "auto")
    assert name == f"opengl-c2w-{kind}" and meant[0].camera == camera
    assert f"the poses are read as {name}, which explains" in reported[-1]


@pytest.mark.slow
def test_none_fits(photographs: list[Photograph], reported: list[str]) -> None:
    """Poses of another path are kept, with a warning; a distortion that is wrong is left out."""
    given = [replace(each, pose=other.pose) for each, other in zip(photographs, photographs[::-1], strict=True)]
    meant, mirror, name = as_meant(given, JSON, np.eye(4), "transforms.json", "auto")
    assert name == "written" and (mirror == np.eye(4)).all() and (poses_of(meant) == poses_of(given)).all()
    assert "transforms.json: the poses fit the photographs badly" in reported[-1]
    assert reported[-1].endswith(f"`bitymi sfm {photographs[0].file.parent}` finds others.")
    lens = ColmapCamera("OPENCV", *SIZE, (*photographs[0].camera.params, 3.0, 9.0, 0.0, 0.0))
    given = [replace(each, camera=lens) for each in photographs]
    meant, _, name = as_meant(given, JSON, np.eye(4), "transforms.json", "auto")
    assert name == "opengl-c2w-no-distortion" and meant[0].camera == photographs[0].camera


def test_what_is_asked_for(photographs: list[Photograph], reported: list[str]) -> None:
    """A name is taken without looking at photographs; too little to look at leaves poses as they are."""
    given = [replace(each, pose=each.pose @ OPENCV_AXES, file=Path("gone.png")) for each in photographs]
    meant, _, name = as_meant(given, JSON, np.eye(4), "transforms.json", "opencv-c2w")
    assert name == "opencv-c2w" and (poses_of(meant) == poses_of(photographs)).all()
    assert decide(given, poses_of(given), JSON) == readings.Decision(JSON)
    assert not reported
    with refused("--poses-as is unity, but transforms.json can be read as auto, written, or as opengl-c2w, "):
        as_meant(given, JSON, np.eye(4), "transforms.json", "unity")
