"""Extract SIFT features of all photographs into COLMAP's database."""

from pathlib import Path

from bitymi_ns.capture import pycolmap
from bitymi_ns.capture.sfm.job import CameraGroup, Job, StageProgress
from bitymi_ns.capture.types import SPHERICAL_MODEL

SMALL = 1000  # photographs with a shorter longer side, pixels, are doubled; larger ones have enough features
SPHERICAL_SCALE = 2
"""Factor on `SMALL` and the largest image size for 360-degree pictures, whose details are small: with half the
features, their camera positions were wrong by a metre among perspective photographs."""


def extract(job: Job, database: Path, tell: StageProgress) -> None:
    """Extract features of the photographs that have none in the database."""
    total = len(job.order)
    tell("finding features", 0, total, counts="keypoints")
    ids = zip(job.cameras, camera_ids(job, database), strict=True)
    groups = [(group, _reader(job, group, camera_id)) for group, camera_id in ids]
    single = {"camera_mode": pycolmap.CameraMode.SINGLE}
    for group, reader in groups:  # before extraction, whose threads would number the photographs in any order
        pycolmap.import_images(database, job.images, image_names=group.names, options=reader, **single)
    for group, reader in groups:
        options = {"reader_options": reader, "extraction_options": _extraction(job, group), **single}
        how = {"image_names": group.names, "device": pycolmap.Device.cpu}
        pycolmap.extract_features(database, job.images, **how, **options)
    tell("finding features", total, total)


def camera_ids(job: Job, database: Path) -> list[int]:
    """Write the groups' cameras that the database lacks after an earlier run, and return the ids of all."""
    with pycolmap.Database.open(database) as opened:
        for group in job.cameras[opened.num_cameras() :]:
            camera = group.camera.colmap
            camera.has_prior_focal_length = group.prior
            opened.write_camera(camera)
        return [camera.camera_id for camera in opened.read_all_cameras()]


def _reader(job: Job, group: CameraGroup, camera_id: int) -> pycolmap.ImageReaderOptions:
    options = pycolmap.ImageReaderOptions()
    options.camera_model = group.camera.model
    options.existing_camera_id = camera_id
    if job.masks is not None:
        options.mask_path = job.masks
    return options


def _extraction(job: Job, group: CameraGroup) -> pycolmap.FeatureExtractionOptions:
    options = pycolmap.FeatureExtractionOptions()
    scale = SPHERICAL_SCALE if group.camera.model == SPHERICAL_MODEL else 1
    options.max_image_size = job.max_image_size * scale
    options.sift.max_num_features = job.max_features
    side = min(max(group.camera.size), options.max_image_size)
    options.sift.first_octave = -1 if side < SMALL * scale else 0
    return options
