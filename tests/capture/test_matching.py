from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bitymi_ns.capture.sfm import matching
from bitymi_ns.capture.sfm.job import CameraGroup, Job
from bitymi_ns.capture.sfm.matching import NEIGHBOURS, is_sequence, nearest_neighbours, sequence
from bitymi_ns.capture.sfm.model_checks import ViewGraph, left_out
from bitymi_ns.capture.types import ColmapCamera


def connected(count: int, found: set[tuple[int, int]]) -> bool:
    graph = ViewGraph({str(i): 100 for i in range(count)}, {(str(i), str(j)): 20 for i, j in found})
    return count < 2 or len(graph.components()[0]) == count


@given(st.integers(2, 40), st.integers(0, 5), st.integers(0, 2**32 - 1))
def test_chosen_pairs_leave_no_part_alone(count: int, most: int, seed: int) -> None:
    alike = np.random.default_rng(seed).integers(0, most + 1, (count, count)).astype(np.float32)
    alike = np.triu(alike, 1) + np.triu(alike, 1).T
    pairs = nearest_neighbours(alike, 3)
    assert connected(count, pairs)
    assert all(0 <= i < j < count for i, j in pairs)
    for i in range(count):  # the best neighbour is among them
        if alike[i].max() > 0:
            assert any(alike[i, j] == alike[i].max() for pair in pairs if i in pair for j in pair if j != i)


def test_a_sequence_is_compared_with_what_follows() -> None:
    pairs = sequence(30)
    assert (0, 1) in pairs and (0, 6) in pairs and (0, 16) in pairs and (0, 7) not in pairs
    assert connected(30, pairs)


def test_a_sequence_is_told_by_its_neighbours() -> None:
    place = np.arange(60)
    alike = np.exp(-np.abs(place[:, None] - place) / 5.0) * (1 - np.eye(60))
    assert is_sequence(alike)
    mixed = np.random.default_rng(0).permutation(60)
    assert not is_sequence(alike[mixed][:, mixed])
    assert NEIGHBOURS < 60


def test_reasons_name_what_is_missing() -> None:
    graph = ViewGraph(
        {"a": 500, "b": 500, "bare": 7, "alone": 400, "c": 300, "d": 300, "weak": 200},
        {("a", "b"): 90, ("c", "d"): 50, ("weak", "a"): 16},
    )
    reasons = left_out(graph, {"a", "b"}, {name: f"{name}.jpg" for name in graph.features})
    assert set(reasons) == {"bare.jpg", "alone.jpg", "c.jpg", "d.jpg", "weak.jpg"}
    assert "hardly any detail in it: 7 features" in reasons["bare.jpg"]
    assert "no other photograph" in reasons["alone.jpg"]
    assert "left out as well" in reasons["c.jpg"]
    assert "16 matches" in reasons["weak.jpg"]


def test_photographs_are_compared_with_those_near_them(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 60
    monkeypatch.setattr(matching, "likeness", lambda job, database, tell: np.zeros((count, count), np.float32))
    order = [f"{i}" for i in np.random.default_rng(0).permutation(count)]
    line = {name: [10.0 * int(name), 0.0, 0.0] for name in order}

    def chosen(places: dict[str, list[float]]) -> set[tuple[int, int]]:
        job = Job("", "", None, [], order, {name: name for name in order}, False, places)
        found = matching.choose(job, Path(), lambda *said: None)
        return {(int(order[i]), int(order[j])) for i, j in found}

    alone = chosen({})
    near = chosen(line) - alone
    assert max(abs(a - b) for a, b in near) <= NEIGHBOURS
    for i in range(count):
        for step in range(1, NEIGHBOURS // 2):  # half of the nearest lie on either side
            assert i + step >= count or {(i, i + step), (i + step, i)} & (near | alone)
    assert chosen({name: line[name] for name in order[:NEIGHBOURS]}) == alone, "a few say nothing of the others"


@pytest.fixture
def two_cameras(tmp_path: Path) -> Job:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    names = [f"{i:06d}.png" for i in range(4)]
    for i, name in enumerate(names):
        Image.fromarray(np.roll(noise, i, axis=1)).save(tmp_path / name)
    cameras = [ColmapCamera("SIMPLE_PINHOLE", 80, 60, (90.0 + i, 40.0, 30.0)) for i in range(2)]
    groups = [CameraGroup(camera, True, names[i::2]) for i, camera in enumerate(cameras)]
    return Job(str(tmp_path), str(tmp_path), None, groups, names, {name: name for name in names}, False, {})


def test_a_run_that_was_killed_between_its_cameras_goes_on(two_cameras: Job, tmp_path: Path) -> None:
    database = tmp_path / "database.db"
    with pycolmap.Database.open(database) as opened:
        opened.write_camera(two_cameras.cameras[0].camera.colmap)
    for _ in range(2):
        matching.extract(two_cameras, database, lambda *told, **more: None)
    with pycolmap.Database.open(database) as opened:
        assert [camera.params[0] for camera in opened.read_all_cameras()] == [90.0, 91.0]
        images = opened.read_all_images()
        assert [image.name for image in images] == [name for group in two_cameras.cameras for name in group.names]
        assert [image.camera_id for image in images] == [1, 1, 2, 2]
        assert all(opened.num_keypoints_for_image(image.image_id) for image in images)
