"""Points for photographs whose cameras are known."""

from pathlib import Path

import numpy as np
import pycolmap

from bitymi_ns.capture.sfm import features, pairs
from bitymi_ns.capture.sfm.job import DATABASE, Job, NoPoses, StageProgress

LEAST = 10  # fewer points are none to start from


def triangulate(job: Job, tell: StageProgress) -> pycolmap.Reconstruction:
    """Triangulate points from a job's photographs with their poses as they are.

    Raises:
        NoPoses: the photographs do not show the same from the poses given.
    """
    database = Path(job.work) / DATABASE
    features.extract(job, database, tell)
    pairs.match(job, database, tell)
    tell("triangulating", 0, 1)
    model = _known(job, database)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = options.mapper.num_threads = job.threads
    options.mapper.filter_max_reproj_error *= job.pixel
    options.triangulation.complete_max_reproj_error *= job.pixel
    options.triangulation.merge_max_reproj_error *= job.pixel
    with job.scratch() as scratch:
        model = pycolmap.triangulate_points(model, database, job.images, scratch, options=options)
    tell("triangulating", 1, 1)
    if model.num_points3D() < LEAST:
        raise NoPoses(
            f"only {model.num_points3D()} points can be triangulated from the given poses: the poses may belong to "
            "other photographs, or be camera to world where world to camera is meant, or have other axes"
        )
    # The poses are written back as given: the triangulation leaves them as they are, but for rounding.
    for image in model.images.values():
        image.frame.rig_from_world = _pose(job.poses[image.name])
    return model


def _pose(matrix: list[list[float]]) -> pycolmap.Rigid3d:
    values = np.array(matrix)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(values[:, :3]), values[:, 3])


def _known(job: Job, database: Path) -> pycolmap.Reconstruction:
    """A model of the cameras and poses, with the numbers that the database has for them."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            points = opened.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            known = pycolmap.Image(image.name, points, image.camera_id, image.image_id)
            model.add_image_with_trivial_frame(known, _pose(job.poses[image.name]))
    return model
