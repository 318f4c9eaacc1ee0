"""Poses that are not rotations, and cameras far from the others."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.pose_checks import check_outliers, check_point_unit, rotations
from tests.captures import load, printed
from tests.changes import matrices, pose
from tests.typed import Printed


def test_rounded_matrices_are_taken(capsys: Printed) -> None:
    exact = Rotation.random(50, random_state=0).as_matrix()
    names = list(range(50))
    four = exact.round(4)
    assert np.array_equal(rotations(four, names, "here"), four) and printed(capsys) == ""
    two = rotations(exact.round(2), names, "here")
    assert np.abs(two @ two.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12 and np.abs(two - exact).max() < 0.01
    assert "here: rotations are off by up to 0.01 in the poses of 3, 6, 9" in printed(capsys)
    single = exact.astype(np.float32).astype(np.float64)
    assert np.array_equal(rotations(single, names, "here"), single)


def test_a_mirrored_capture_is_taken_and_a_mirrored_frame_is_named(capture: Path, capsys: Printed) -> None:
    matrices(lambda pose: pose * [-1, 1, 1, 1])(capture)
    c2w = load(capture).train_dataset.cameras.camera_to_worlds
    assert (torch.linalg.det(c2w[:, :, :3]) < 0).all() and "mirrored against the other" not in printed(capsys)
    pose(lambda part: part * [-1, 1, 1])(capture)
    load(capture)
    assert "images/frame_00004.png is mirrored against the other frames" in (message := printed(capsys))
    assert message.count("mirrored against") == 1


def test_groups_of_cameras_are_neither_a_mistake_nor_another_unit(capsys: Printed) -> None:
    generator = np.random.default_rng(0)
    tripod, walk = 1e-4 * generator.normal(size=(30, 3)), 5.0 + generator.normal(size=(10, 3))
    check_outliers(np.concatenate([tripod, walk]), list(range(40)))
    check_outliers(np.zeros((5, 3)), list(range(5)))
    points, tripod, walk = (generator.normal(size=(n, 3)) for n in (200, 30, 10))
    check_point_unit(points, np.concatenate([1e-4 * tripod, 2.0 + walk]), np.ones(40))
    check_point_unit(points[:0], tripod, np.ones(30))
    check_point_unit(np.zeros((9, 3)), tripod, np.ones(30))
    assert printed(capsys) == ""
