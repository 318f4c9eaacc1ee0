"""Models that contradict their matches, and cameras that are not linked to others."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from bitymi_ns.capture.sfm.model_checks import contradicted, drop_unlinked


@pytest.fixture
def model(tmp_path: Path) -> tuple[pycolmap.Reconstruction, Path]:
    """Eight cameras around 200 points seen by all, with noise, and their matches in a database."""
    database = tmp_path / "database.db"
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8,
                                               num_points3D=200)  # fmt: skip
    with pycolmap.Database.open(database) as opened:
        made = pycolmap.synthesize_dataset(options, opened)
    return made, database


def test_right_poses_contradict_no_match(model: tuple[pycolmap.Reconstruction, Path]) -> None:
    made, database = model
    assert contradicted(made, database, 1.0) == 0.0


def test_turned_cameras_contradict_their_matches_with_the_others(model: tuple[pycolmap.Reconstruction, Path]) -> None:
    made, database = model
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.7, 0.0])), np.zeros(3))
    for frame in (1, 2):  # 12 of 28 pairs include one of them; they agree with each other
        made.frame(frame).rig_from_world = made.frame(frame).rig_from_world * turn
    share = contradicted(made, database, 1.0)
    assert 12 / 28 - 0.05 < share <= 12 / 28
    assert contradicted(made, database, 1000.0) < share  # the limit is in pixels of the features' images


def test_rays_that_meet_behind_a_camera_contradict(model: tuple[pycolmap.Reconstruction, Path]) -> None:
    made, database = model
    for frame in made.frames.values():  # mirrored through the origin: the same epipolar planes
        pose = frame.rig_from_world
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, -pose.translation)
    assert contradicted(made, database, 1.0) == 1.0


def test_cameras_that_share_no_points_with_the_others_lose_their_pose(
    model: tuple[pycolmap.Reconstruction, Path],
) -> None:
    made, _ = model
    drop_unlinked(made)
    assert made.num_reg_images() == 8
    group = {1, 2, 3}
    tracks = [[(e.image_id, e.point2D_idx) for e in point.track.elements] for point in made.points3D.values()]
    for i, track in enumerate(tracks[14:]):  # 14 points still link both parts
        for image, feature in track:
            if (image in group) != (i % 2 == 0):
                made.delete_observation(image, feature)
    drop_unlinked(made)
    assert {image.image_id for image in made.images.values() if image.has_pose} == {4, 5, 6, 7, 8}
