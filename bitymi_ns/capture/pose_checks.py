"""Check poses: rotations (also mirrored), positions that belong together, and points in their unit."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bitymi_ns.trust import listed
from .types import FrameOptions, Photograph, fail, say, warn

EXACT = 1e-3  # error of rotations taken as they are: four digits
ROUNDED = 2e-2  # error of rounded rotations: two digits
FAR = 100.0  # relative distance from which a camera may be misplaced
TOO_FAR = 1000.0  # relative distance that shrinks the other cameras to one point
FAR_FROM_ORIGIN = 100.0  # relative distance from the origin at which float32 blurs cameras
OTHER_UNIT = 150.0  # ratio of distances, or of picture and cloud, that tells another unit
USUAL_SPREAD, MAX_SPREAD = 2.5, 25.0
"""Median distance of cameras from their middle in half sides of the scene box: NeRF-Synthetic's, and the largest."""


def rotations(matrices: npt.NDArray[np.float64], names: Sequence[object], source: str) -> npt.NDArray[np.float64]:
    """Recover rotations, also mirrored, from the 3 x 3 parts [N, 3, 3] of poses: divide out their factors, and undo
    rounding by the nearest rotation; valid ones stay equal. Raises CaptureError: one is not finite, zero or sheared."""
    result = matrices.copy()
    finite = np.isfinite(matrices).all((1, 2))
    largest = np.abs(np.where(finite[:, None, None], matrices, 0.0)).max((1, 2))  # squares may overflow
    usable = largest > 0.0
    unit = np.where(usable[:, None, None], matrices, 1.0) / np.where(usable, largest, 1.0)[:, None, None]
    length = np.sqrt(np.square(unit).sum((1, 2)) / 3.0)
    scale, unit = largest * length, unit / length[:, None, None]
    error = np.abs(unit.transpose(0, 2, 1) @ unit - np.eye(3)).max((1, 2))

    def named(wrong: npt.NDArray[np.bool_]) -> str:
        return listed([names[i] for i in wrong.nonzero()[0]])

    for what, wrong in (
        ("is not finite", ~finite),
        ("is zero", finite & ~usable),
        ("is sheared or stretched: its columns are not at right angles and equally long", usable & (error > ROUNDED)),
    ):
        if wrong.any():
            fail(f"{source}: the 3 x 3 part of the pose of {named(wrong)} {what}. Correct it or remove the frame.")
    scaled = np.abs(scale - 1.0) > EXACT
    result[scaled] = unit[scaled]
    rounded = error > EXACT
    u, _, v = np.linalg.svd(unit[rounded])
    result[rounded] = u @ v
    if scaled.any():
        low, high = scale[scaled].min(), scale[scaled].max()
        factor = f"{low:.4g}" if high - low <= EXACT * high else f"{low:.4g} to {high:.4g}"
        warn(f"{source}: rotations are scaled by {factor} in the poses of {named(scaled)}. It is divided out.")
    if (only_rounded := rounded & ~scaled).any():
        off = f"rotations are off by up to {error[only_rounded].max():.1g} in the poses of {named(only_rounded)}"
        warn(f"{source}: {off}. The nearest ones are used.")
    return result


def correct_poses(path: Path, frames: list[dict[str, Any]]) -> None:
    """Check the poses of a transforms.json's frames, and make rotations of them."""
    names = [frame["file_path"] for frame in frames]
    poses, scaled = [], []
    for frame, name in zip(frames, names, strict=True):
        pose = as_matrix(frame["transform_matrix"])
        if pose is None:
            fail(f"{path}: the transform_matrix of {name} is not 4 x 4 finite numbers. Correct it or remove the frame.")
        if pose[3, 3] and not pose[3, :3].any():
            scaled += [name] * bool(abs(pose[3, 3] - 1.0) > 1e-6)  # numpy 2.5 multiplies no list by its own
            pose = pose / pose[3, 3]  # homogeneous
        if np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
            what = f"the last row of the transform_matrix of {name} is {' '.join(f'{x:g}' for x in pose[3])}"
            fail(f"{path}: {what}, not 0 0 0 1. If that is its position, transpose it.")
        poses.append(pose)
    if scaled:
        say(f"{path}: the transform_matrix of {listed(scaled)} is divided by its last number.")
    matrices = np.stack(poses)
    matrices[:, :3, :3] = rotations(matrices[:, :3, :3], names, str(path))
    first: dict[str, int] = {}
    for i, (frame, pose, name) in enumerate(zip(frames, matrices, map(os.path.normpath, names), strict=True)):
        before = first.setdefault(name, i)
        if not np.allclose(matrices[before], pose, rtol=1e-5, atol=1e-5):
            twice = f"frames {before} and {i} (counted from 0) are both of {name}, with different poses"
            fail(f"{path}: {twice}. Correct the name of one or remove it.")
        frame["transform_matrix"] = pose.tolist()


def as_matrix(value: Any) -> np.ndarray | None:
    """Convert 3 x 4 or 4 x 4 finite numbers to [4, 4]; else None."""
    with suppress(ValueError, TypeError, OverflowError):
        matrix = np.asarray(value, dtype=np.float64)
        if matrix.shape in ((3, 4), (4, 4)) and np.isfinite(matrix).all():
            return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])[:4]
    return None


def warn_of_mirrored(rotations: npt.NDArray[np.float64], names: Sequence[object]) -> None:
    """Warn of frames mirrored against the others; rotations [N, 3, 3]."""
    mirrored = np.linalg.det(rotations) < 0.0
    few = mirrored if 2 * mirrored.sum() <= len(mirrored) else ~mirrored
    if few.any():
        which = f"{listed([names[i] for i in few.nonzero()[0]])} is mirrored against the other frames"
        warn(f"{which} by its pose. If the photograph is not mirrored, too, the pose is wrong.")


def check_spread(centers: npt.NDArray[np.float64], source: str) -> None:
    """Fail if all cameras [N, 3] are at one place."""
    if not np.ptp(centers, axis=0).any():
        fail(f"{source}: all cameras are at one place. Photograph from different places.")


def check_outliers(centers: npt.NDArray[np.float64], names: Sequence[object]) -> None:
    """Warn of single cameras far from all others, or fail; centers [N, 3] are finite."""
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    order = np.argsort(distances)
    near, far = distances[order][:-1], distances[order][1:]
    apart = np.flatnonzero((near > 0.0) & (far >= FAR * near)) + 1
    apart = apart[apart >= len(order) - max(1, len(order) // 10)]  # more than a tenth is a group of its own
    if len(apart):
        k = apart[0]
        times = f"{far[k - 1] / near[k - 1]:,.0f} times as far from the middle as the others"
        message = f"the camera of {listed([names[i] for i in order[k:]])} is {times}"
        if far[k - 1] >= TOO_FAR * near[k - 1]:
            fail(f"{message}: beside it they are all at one place. Correct the pose or remove the frame.")
        warn(f"T{message[1:]}. If that is a mistake, correct the pose or remove the frame.")


def far_from_origin(centers: npt.NDArray[np.float64]) -> bool:
    """Test for cameras [N, 3] too far from the origin for float32."""
    middle = centers.mean(0)
    spread = np.linalg.norm(centers - middle, axis=1).max()
    return bool(0.0 < FAR_FROM_ORIGIN * spread < np.linalg.norm(middle))


def fit_scale(frame: FrameOptions, photographs: Sequence[Photograph], source: str) -> FrameOptions:
    """Reduce the scale of a capture whose cameras lie far outside the scene box, as in millimetres: random points would
    all be one spot of the pictures. `frame`: the format's default."""
    centers = np.stack([photograph.pose[:3, 3] for photograph in photographs])
    spread = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    ratio = spread * frame.scale_factor / frame.scene_scale
    if ratio <= MAX_SPREAD:
        return frame
    scale = frame.scale_factor * USUAL_SPREAD / ratio
    usual = f"where those of this format usually lie {USUAL_SPREAD * frame.scene_scale / frame.scale_factor:.2g}"
    say(f"The cameras of {source} lie {spread:,.4g} units from their middle, {usual}: they are scaled by {scale:.3g}.")
    return replace(frame, scale_factor=scale)


def check_point_unit(
    points: npt.NDArray[np.float64], centers: npt.NDArray[np.float64], widths: npt.NDArray[np.float64]
) -> None:
    """Warn if points [N, 3] seem to be in another unit than finite cameras [M, 3], with `widths` [M] in focal lengths:
    far beyond them, or in a spot of the pictures."""
    points = points[:: max(1, len(points) // 100_000)]
    points = points[np.isfinite(points).all(1)]
    if len(points) == 0:
        return
    middle, cloud_middle = np.median(centers, axis=0), np.median(points, axis=0)
    apart = np.percentile(np.linalg.norm(centers - middle, axis=1), 90)  # most may stand on one tripod
    away = np.median(np.linalg.norm(points - middle, axis=1))
    spread = np.median(np.linalg.norm(points - cloud_middle, axis=1))
    picture = np.median(np.linalg.norm(centers - cloud_middle, axis=1) * widths)  # picture width at the cloud
    far, near = away > OTHER_UNIT * apart > 0.0, 0.0 < spread < picture / OTHER_UNIT
    if far or near:
        what = f"half of the points lie {'far beyond the cameras' if far else 'in a spot of the pictures'}"
        warn(f"The point cloud seems to be in another unit than the poses: {what}. Correct or remove it.")
