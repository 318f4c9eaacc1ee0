"""Camera poses from compared photographs: all at once first, one after the other where that falls short."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pycolmap

from bitymi_ns.capture.sfm.consistency import contradicted, drop_unlinked
from bitymi_ns.capture.sfm.job import Job, StageProgress
from bitymi_ns.capture.sfm.refine import refined
from bitymi_ns.capture.types import CONTRADICTED

Mapper = Callable[[Job, Path, Path, StageProgress], dict[int, pycolmap.Reconstruction]]
"""Maps the features and matches of a database with a folder for its files; returns connected components."""
ENOUGH = 0.9
"""The global mapper's poses are taken as they are if they are of this share of the photographs that hang together."""
GOOD_ERROR = 1.0
"""... and their reprojection error is below so many pixels of the photographs as features were found on them, and few
matches contradict them."""


def reconstruct(job: Job, database: Path, connected: int, tell: StageProgress) -> pycolmap.Reconstruction | None:
    """The best model of the photographs, or None where there is none; `connected` of them hang together by verified
    pairs."""
    found = None
    if job.mapper in ("auto", "global"):
        found = _mapped(_global, job, database, tell)
        if job.mapper == "global" or (found is not None and _satisfies(found, job, database, connected)):
            return found
    return better(job, database, found, _mapped(_incremental, job, database, tell))


def better(job: Job, database: Path, *models: pycolmap.Reconstruction | None) -> pycolmap.Reconstruction | None:
    """The model with most cameras, of equals that which fewest matches contradict; None if there is none."""
    found = [model for model in models if model is not None]
    most = max((model.num_reg_images() for model in found), default=0)
    equal = [model for model in found if model.num_reg_images() == most]
    if len(equal) < 2:  # no matches need to be read
        return equal[0] if equal else None
    return min(equal, key=lambda model: contradicted(model, database, job.pixel))


def _satisfies(model: pycolmap.Reconstruction, job: Job, database: Path, connected: int) -> bool:
    return (
        model.num_reg_images() >= ENOUGH * connected
        and model.compute_mean_reprojection_error() <= GOOD_ERROR * job.pixel
        and contradicted(model, database, job.pixel) <= CONTRADICTED
    )


def _mapped(mapper: Mapper, job: Job, database: Path, tell: StageProgress) -> pycolmap.Reconstruction | None:
    """The largest component of a mapper's, refined, of the cameras that its points link."""
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
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.num_threads = options.mapper.num_threads = job.threads
    options.mapper.bundle_adjustment.ceres.solver_options.num_threads = job.threads
    copy = folder / "database.db"  # its focal lengths are changed, which the other mapper starts from
    shutil.copyfile(database, copy)
    calibration = pycolmap.ViewGraphCalibrationOptions()  # finds focal lengths, and finds out wrong ones from EXIF
    calibration.random_seed = 0
    pycolmap.calibrate_view_graph(copy, calibration)
    models = pycolmap.global_mapping(copy, job.images, folder, options)
    tell(stage, 1, 1)
    return models


def _incremental(job: Job, database: Path, folder: Path, tell: StageProgress) -> dict[int, pycolmap.Reconstruction]:
    stage = "placing one camera after the other"
    placed = 0
    total = len(job.order)

    def one_more() -> None:
        nonlocal placed
        placed += 1
        tell(stage, min(placed, total), total)

    tell(stage, 0, total)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = options.mapper.num_threads = job.threads
    options.min_model_size = min(10, max(3, total // 2))
    models = pycolmap.incremental_mapping(
        database, job.images, folder, options, next_image_callback=one_more, initial_image_pair_callback=one_more
    )
    tell(stage, total, total)
    return models
