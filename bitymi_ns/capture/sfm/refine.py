"""The last bundle adjustment of a model, and the camera model that suits it."""

import copy

import pycolmap

from bitymi_ns.capture.sfm.job import Job

MAX_ERROR = 4.0
"""Observations farther off, in pixels of the images on which features were found, are dropped; COLMAP's own limit."""
MIN_ANGLE = 1.5  # degrees between rays below which a point has no depth to be trusted; COLMAP's own limit
GAIN = 0.03
"""OPENCV replaces SIMPLE_RADIAL if it lowers the reprojection error by this share: its four terms are there to be
misused by few observations."""
OBSERVATIONS_PER_CAMERA = 2000  # a camera with fewer observations keeps the simple model


def refined(model: pycolmap.Reconstruction, job: Job) -> pycolmap.Reconstruction:
    """Drop what does not fit, adjust all cameras and points of a mapper's `model` in place, and drop again."""
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
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = job.threads
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-5
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _filter(model: pycolmap.Reconstruction, pixel: float) -> None:
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR * pixel, MIN_ANGLE)
    model.update_point_3d_errors()
