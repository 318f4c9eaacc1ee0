"""Decide by the photographs how poses and intrinsics of a capture are to be read."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.cache import content_key
from bitymi_ns.capture.types import OPENCV_AXES, SPHERICAL_MODEL, ColmapCamera, Photograph, Pose, fail, warn
from bitymi_ns.trust import listed

AUTO, WRITTEN = "auto", "written"
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
CAMERA_AXES = {"opengl": np.eye(4), "opencv": OPENCV_AXES, "lefthanded": MIRROR}
TURNS = {"": 0, "turn90": 90, "turn180": 180, "turn270": 270}  # degrees about the optical axis
SWAPPED, NO_DISTORTION = "swapped", "undistorted"
INTRINSICS = {f"intrinsics{factor:g}": factor for factor in (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)}
"""Factors on focal lengths and principal points, as of pictures of another size."""
ENOUGH = 100  # matches that decide
FITS = 0.5  # least share of matches that poses explain, relative to what the pairs' own poses explain
LEAD = 2.0
"""Least ratio of what a reading explains to what the poses explain as written: at most 0.26 in captures that are right as
written, at least 3.9 in others."""


class Reading(NamedTuple):
    """Convention of poses."""

    axes: str = "opengl"
    direction: str = "c2w"
    order: str = ""  # of quaternions; empty = matrices
    turn: str = ""
    intrinsics: str = ""

    @property
    def name(self) -> str:
        """Name of the option --poses-as."""
        return "-".join(filter(None, self))


def readings(own: Reading) -> list[Reading]:
    """List the readings of a format with its `own` convention, those that differ least first."""
    orders = ("xyzw", "wxyz") if own.order else ("",)
    every = product(CAMERA_AXES, ("c2w", "w2c"), orders, TURNS, ("", *INTRINSICS, SWAPPED, NO_DISTORTION))
    return sorted(
        (Reading(*each) for each in every), key=lambda each: sum(a != b for a, b in zip(each, own, strict=True))
    )


def read_as(poses: Pose, own: Reading, reading: Reading) -> tuple[Pose, Pose]:
    """Convert poses [N, 4, 4], camera to world with OpenGL axes by a format's `own` convention, to those of a reading;
    also return the reflection [4, 4] of their world if that was left-handed, else the identity."""
    if reading[:4] == own[:4]:
        return poses, np.eye(4)
    matrices = poses @ CAMERA_AXES[own.axes]
    matrices = np.linalg.inv(matrices) if own.direction == "w2c" else matrices
    if reading.order != own.order:
        x, y, z, w = Rotation.from_matrix(matrices[:, :3, :3]).as_quat().T
        meant = (w, x, y, z) if own.order == "wxyz" else (y, z, w, x)
        matrices[:, :3, :3] = Rotation.from_quat(np.stack(meant, 1)).as_matrix()
    matrices = np.linalg.inv(matrices) if reading.direction == "w2c" else matrices
    matrices = matrices @ CAMERA_AXES[reading.axes]
    mirrored = reading.axes == "lefthanded" and np.median(np.linalg.det(matrices)) < 0.0
    world = MIRROR if mirrored else np.eye(4)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", TURNS[reading.turn], degrees=True).as_matrix().round()
    return world @ matrices @ turn, world


def camera_as(camera: ColmapCamera, kind: str) -> ColmapCamera:
    """Convert a camera to other intrinsics; that of 360-degree pictures has none."""
    if not kind or camera.model == SPHERICAL_MODEL:
        return camera
    lens, params = camera.colmap, np.array(camera.params)
    if kind == NO_DISTORTION:
        K = lens.calibration_matrix()
        return camera._replace(model="PINHOLE", params=(*K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),))
    for indices in map(list, (lens.focal_length_idxs(), lens.principal_point_idxs())):
        params[indices] = params[indices][::-1] if kind == SWAPPED else params[indices] * INTRINSICS[kind]
    return camera._replace(params=tuple(params.tolist()))


class Decision(NamedTuple):
    """Reading that the photographs ask for (None = none explains them), and shares of matches that are explained."""

    reading: Reading | None
    share: float = 0.0  # by the reading that explains most
    written: float = 0.0
    own: float = 0.0  # by the pairs' own poses
    worst: tuple[str, ...] = ()  # photographs whose matches are explained least


def decide(photographs: Sequence[Photograph], poses: Pose, written: Reading) -> Decision:
    """Find the reading by which the poses explain by far most of what pairs of photographs have in common; as written
    if there is too little of that, or a camera cannot be used."""
    from bitymi_ns.capture import two_views  # slow to import

    cameras, every = [each.camera for each in photographs], readings(written)
    lenses = [camera.colmap for camera in dict.fromkeys(cameras)]
    focals = [value for lens in lenses for value in lens.params[lens.focal_length_idxs()]]
    usable = all(np.isfinite(lens.params).all() for lens in lenses) and min(focals, default=1.0) > 0.0
    pairs = two_views.match_pairs(photographs) if usable else []
    own, total = two_views.explained(pairs, two_views.rays_of(pairs, cameras)), sum(len(pair.x) for pair in pairs)
    if own.sum() < ENOUGH:
        return Decision(written)
    counts: dict[Reading, npt.NDArray[np.int64]] = {}
    for kinds in ([""], [*INTRINSICS, SWAPPED, NO_DISTORTION]):
        for kind in kinds:
            rays = two_views.rays_of(pairs, [camera_as(camera, kind) for camera in cameras])
            some = [each for each in every if each.intrinsics == kind]
            counts |= {each: two_views.explained(pairs, rays, read_as(poses, written, each)[0]) for each in some}
        best = max(counts, key=lambda each: counts[each].sum())
        share, as_written, most = (float(each.sum() / total) for each in (counts[best], counts[written], own))
        if share >= max(FITS * most, LEAD * as_written):
            return Decision(best, share, as_written, most)
        if as_written >= FITS * most:
            return Decision(written, share, as_written, most)
    sums = np.zeros((2, len(photographs)))
    for pair, *both in zip(pairs, counts[written], own, strict=True):
        sums[:, [pair.first, pair.second]] += np.array(both)[:, None]
    worst = [photographs[i].file.name for i in np.argsort(sums[0] / np.maximum(sums[1], 1e-9)) if sums[1, i]]
    return Decision(None, share, as_written, most, tuple(worst[:3]))


_decided: dict[str, Decision] = {}  # commands read a capture twice: to check it first, and to use it


def as_meant(
    photographs: Sequence[Photograph], written: Reading, frame: Pose, source: str, asked: str
) -> tuple[list[Photograph], Pose, str]:
    """Give photographs the poses and intrinsics of a reading, and say so.

    Args:
        written: convention of the format.
        frame: transform [4, 4] from the world of its files to that of the photographs.
        asked: name of the reading, WRITTEN, or AUTO: the photographs decide.

    Returns:
        photographs, the reflection [4, 4] of their world (the identity unless it was left-handed), and the name.

    Raises:
        CaptureError: the format has no such reading.
    """
    named = {WRITTEN: written} | {each.name: each for each in readings(written)}
    poses, decision = np.linalg.inv(frame) @ np.stack([each.pose for each in photographs]), Decision(named.get(asked))
    if asked == AUTO:
        files = [(each.file.name, each.file) for each in photographs]
        key = content_key(files, [(each.camera, each.pose.tolist(), str(each.mask)) for each in photographs])
        decision = _decided[key] = _decided.get(key) or decide(photographs, poses, written)
    elif decision.reading is None:
        some = [each.name for each in named.values() if not each.turn and not each.intrinsics]
        fail(f"--poses-as is {asked}, but {source} can be read as {AUTO}, {WRITTEN}, or as {', '.join(some[1:])}.")
    reading, explains = decision.reading, "of what pairs of photographs have in common"
    if reading is None:
        warn(
            f"{source}: the poses fit the photographs badly: they explain {decision.written:.0%} {explains}, where "
            f"{decision.own:.0%} can be; least in {listed(decision.worst)}. `bitymi sfm` finds poses from photographs."
        )
    if reading is None or reading == written:
        return list(photographs), np.eye(4), WRITTEN
    if asked == AUTO:
        warn(
            f"{source}: the poses are read as {reading.name}, which explains {decision.share:.0%} {explains}; as "
            f"written ({written.name}), {decision.written:.0%}. `bitymi-data --poses-as {WRITTEN}` keeps those."
        )
    meant, world = read_as(poses, written, reading)
    photographs = [replace(each, pose=frame @ pose, camera=camera_as(each.camera, reading.intrinsics))
                   for each, pose in zip(photographs, meant, strict=True)]  # fmt: skip
    return photographs, frame @ world @ np.linalg.inv(frame), reading.name
