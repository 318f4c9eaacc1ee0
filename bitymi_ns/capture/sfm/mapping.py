"""Map matched photographs: all at once, else one after the other; or triangulate points for known cameras."""

import copy
import shutil
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np

from .. import pycolmap
from ..types import CONTRADICTED
from . import matching, model_checks
from .job import DATABASE, MAX_ERROR, Job, NoPoses, StageProgress
from .model_checks import contradicted, drop_unlinked

Mapper = Callable[[Job, Path, Path, StageProgress], dict[int, pycolmap.Reconstruction]]
"""Maps a database's features and matches, given a folder for files; returns connected components."""
ENOUGH = 0.9  # share of the connected photographs in a good global model
GOOD_ERROR = 1.0  # and its reprojection error, in pixels of the images with features

MIN_ANGLE = 1.5  # least angle between rays of a point with depth, degrees; COLMAP's own limit
GAIN = 0.03  # least relative drop of the reprojection error to choose OPENCV
OBSERVATIONS_PER_CAMERA = 2000  # least for OPENCV: fewer overfit its four terms
LEAST_POINTS = 10  # to start from
TELLING = 100  # least matches of all pairs that blame the poses


def reconstruct(job: Job, database: Path, connected: int, tell: StageProgress) -> pycolmap.Reconstruction | None:
    """Find the best model of the photographs, of which verified pairs connect `connected`; None = none."""
    model = None if job.mapper == "incremental" else _mapped(_global, job, database, tell)
    if job.mapper == "global":
        return model
    if model is not None and model.num_reg_images() >= ENOUGH * connected:
        exact = model.compute_mean_reprojection_error() <= GOOD_ERROR * job.pixel
        if exact and contradicted(model, database, job.pixel) <= CONTRADICTED:
            return model
    return better(job, database, model, _mapped(_incremental, job, database, tell))


def better(job: Job, database: Path, *models: pycolmap.Reconstruction | None) -> pycolmap.Reconstruction | None:
    """Choose the model with most cameras, of equals that which fewest matches contradict."""
    known = [model for model in models if model is not None]
    most = max((model.num_reg_images() for model in known), default=0)
    equal = [model for model in known if model.num_reg_images() == most]
    return min(equal, key=lambda m: contradicted(m, database, job.pixel) if len(equal) > 1 else 0.0, default=None)


def _mapped(mapper: Mapper, job: Job, database: Path, tell: StageProgress) -> pycolmap.Reconstruction | None:
    """Map, refine the largest component, and drop cameras that its points do not link."""
    with job.scratch() as folder:
        models = mapper(job, database, folder, tell)
    largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if largest is None or largest.num_points3D() == 0:
        return None
    tell("refining cameras and points", 0, 1)
    model = refined(largest, job)
    drop_unlinked(model)
    tell("refining cameras and points", 1, 1)
    return model


def _global(job: Job, database: Path, folder: Path, tell: StageProgress) -> dict[int, pycolmap.Reconstruction]:
    stage = "placing all cameras at once"
    tell(stage, 0, 1)
    options = pycolmap.GlobalPipelineOptions(random_seed=0, num_threads=job.threads)
    options.mapper.num_threads = job.threads
    options.mapper.bundle_adjustment.ceres.solver_options.num_threads = job.threads
    copy = folder / "database.db"  # its focal lengths change; the other mapper keeps the original
    shutil.copyfile(database, copy)
    # finds focal lengths, and wrong ones of EXIF
    pycolmap.calibrate_view_graph(copy, pycolmap.ViewGraphCalibrationOptions(random_seed=0))
    models = pycolmap.global_mapping(copy, job.images, folder, options)
    tell(stage, 1, 1)
    return models


def _incremental(job: Job, database: Path, folder: Path, tell: StageProgress) -> dict[int, pycolmap.Reconstruction]:
    stage = "placing one camera after the other"
    placed, total = count(1), len(job.order)

    def one_more() -> None:
        tell(stage, min(next(placed), total), total)

    tell(stage, 0, total)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=job.threads)
    options.mapper.num_threads = job.threads
    options.min_model_size = min(10, max(3, total // 2))
    models = pycolmap.incremental_mapping(
        database, job.images, folder, options, next_image_callback=one_more, initial_image_pair_callback=one_more
    )
    tell(stage, total, total)
    return models


def refined(model: pycolmap.Reconstruction, job: Job) -> pycolmap.Reconstruction:
    """Adjust cameras and points of a `model` in place; return it, or one with OPENCV cameras that fits better."""
    _filter(model, job.pixel)
    if model.num_points3D() == 0:
        return model
    _adjust(model, job)
    _filter(model, job.pixel)
    if job.opencv_if_better and model.compute_num_observations() >= OBSERVATIONS_PER_CAMERA * model.num_cameras():
        freer = copy.deepcopy(model)
        for camera in freer.cameras.values():
            if camera.model_name == "SIMPLE_RADIAL":
                focal, cx, cy, k = camera.params
                camera.model = pycolmap.CameraModelId.OPENCV
                camera.params = [focal, focal, cx, cy, k, 0.0, 0.0, 0.0]
        _adjust(freer, job)
        if freer.compute_mean_reprojection_error() < (1 - GAIN) * model.compute_mean_reprojection_error():
            _filter(freer, job.pixel)
            return freer
    return model


def _adjust(model: pycolmap.Reconstruction, job: Job) -> None:
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = job.threads
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-5
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _filter(model: pycolmap.Reconstruction, pixel: float) -> None:
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR * pixel, MIN_ANGLE)
    model.update_point_3d_errors()


def triangulate(job: Job, tell: StageProgress) -> pycolmap.Reconstruction:
    """Triangulate points with a job's known poses. Raises NoPoses: hardly any, so the poses may be wrong."""
    database = Path(job.work) / DATABASE
    matching.extract(job, database, tell)
    matching.match(job, database, tell)
    tell("triangulating", 0, 1)
    model = _known(job, database)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=job.threads)
    options.mapper.num_threads = job.threads
    options.mapper.filter_max_reproj_error *= job.pixel
    options.triangulation.complete_max_reproj_error *= job.pixel
    options.triangulation.merge_max_reproj_error *= job.pixel
    with job.scratch() as scratch:
        model = pycolmap.triangulate_points(model, database, job.images, scratch, options=options)
    tell("triangulating", 1, 1)
    if model.num_points3D() < LEAST_POINTS:
        matches = sum(model_checks.view_graph(database).inliers.values())
        why = "the poses may belong to other photographs, or have another convention"
        if matches < TELLING:
            why = f"the photographs share hardly any detail, {matches} matches in all"
        raise NoPoses(f"only {model.num_points3D()} points can be triangulated from the given poses: {why}")
    # the triangulation changes poses by rounding
    for image in model.images.values():
        image.frame.rig_from_world = _pose(job.poses[image.name])
    return model


def _pose(matrix: list[list[float]]) -> pycolmap.Rigid3d:
    values = np.array(matrix)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(values[:, :3]), values[:, 3])


def _known(job: Job, database: Path) -> pycolmap.Reconstruction:
    """Make a model of known cameras and poses, with the database's numbers."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            points = opened.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            known = pycolmap.Image(image.name, points, image.camera_id, image.image_id)
            model.add_image_with_trivial_frame(known, _pose(job.poses[image.name]))
    return model
