"""Features of a killed run."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from bitymi_ns.capture.sfm import pairs
from bitymi_ns.capture.sfm.job import CameraGroup, Job
from bitymi_ns.capture.types import ColmapCamera


@pytest.fixture
def job(tmp_path: Path) -> Job:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    names = [f"{i:06d}.png" for i in range(4)]
    for i, name in enumerate(names):
        Image.fromarray(np.roll(noise, i, axis=1)).save(tmp_path / name)
    cameras = [ColmapCamera("SIMPLE_PINHOLE", 80, 60, (90.0 + i, 40.0, 30.0)) for i in range(2)]
    groups = [CameraGroup(camera, True, names[i::2]) for i, camera in enumerate(cameras)]
    return Job(str(tmp_path), str(tmp_path), None, groups, names, {name: name for name in names}, False, {})


def test_a_run_that_was_killed_between_its_cameras_goes_on(job: Job, tmp_path: Path) -> None:
    database = tmp_path / "database.db"
    with pycolmap.Database.open(database) as opened:
        opened.write_camera(job.cameras[0].camera.colmap)
    for _ in range(2):
        pairs.extract(job, database, lambda *told, **more: None)
    with pycolmap.Database.open(database) as opened:
        assert [camera.params[0] for camera in opened.read_all_cameras()] == [90.0, 91.0]
        images = opened.read_all_images()
        assert [image.name for image in images] == [name for group in job.cameras for name in group.names]
        assert [image.camera_id for image in images] == [1, 1, 2, 2]
        assert all(opened.num_keypoints_for_image(image.image_id) for image in images)
