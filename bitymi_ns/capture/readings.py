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
CAMERA_AXES = {"opengl": np.eye(4), "opencv": OPENCV_AXES, "left-handed": MIRROR}
TURNS = {"turn90": 90, "turn180": 180, "turn270": 270}
SWAPPED, NO_DISTORTION = "swapped-intrinsics", "no-distortion"
INTRINSICS = {**{f"intrinsics{factor:g}": factor for factor in (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)}, SWAPPED: 1.0}
"""Factors on focal lengths and principal points."""
WORDS = {
    "opengl": "in OpenGL's camera axes (y up, z backward)", "opencv": "in OpenCV's camera axes (y down, z forward)",
    "left-handed": "left-handed, as Unity's", "c2w": "camera to world", "w2c": "world to camera",
    "wxyz": "with quaternions in the order w, x, y, z", "xyzw": "with quaternions in the order x, y, z, w",
    **{name: f"turned by {angle} degrees about the optical axis" for name, angle in TURNS.items()},
    **{name: f"with the intrinsics times {factor:g}" for name, factor in INTRINSICS.items()},
    SWAPPED: "with the intrinsics of pictures whose sides are swapped", NO_DISTORTION: "without lens distortion",
}  # fmt: skip
"""Parts of the names of readings, and what they say of poses."""
ENOUGH = 100  # matches that decide
FITS = 0.5  # least share of the matches that poses explain, relative to what the pairs' own poses explain
LEAD = 2.0
"""Least ratio of what a reading explains to what the poses explain as written; in captures that are right as written it
is at most 0.4, in others at least 7."""


class Convention(NamedTuple):
    """Convention of a format's poses."""

    axes: str = "opengl"
    direction: str = "c2w"
    order: str = ""  # of quaternions; empty = matrices
    frame: Pose = np.eye(4)  # [4, 4] from the poses' world to that of the photographs


class Reading(NamedTuple):
    """Differences of a reading from the convention of the format; empty = as written."""

    axes: str = ""
    direction: str = ""
    order: str = ""
    turn: str = ""
    intrinsics: str = ""

    @property
    def name(self) -> str:
        """Name of the option --poses-as."""
        return "-".join(filter(None, self)) or WRITTEN


def readings(convention: Convention) -> dict[str, Reading]:
    """List the readings of a format's poses by name; those with few differences first."""

    def others(own: str, *every: str) -> list[str]:
        return ["", *(each for each in every if each != own)]

    orders = others(convention.order, "wxyz", "xyzw") if convention.order else [""]
    axes = others(convention.axes, "opengl", "opencv", "left-handed")
    every = product(
        axes, others(convention.direction, "c2w", "w2c"), orders, ["", *TURNS], ["", *INTRINSICS, NO_DISTORTION]
    )
    found = sorted((Reading(*each) for each in every), key=lambda each: sum(map(bool, each)))
    return {each.name: each for each in found}


def read_as(poses: Pose, convention: Convention, reading: Reading) -> tuple[Pose, Pose | None]:
    """Convert poses [N, 4, 4], camera to world with OpenGL axes as written, by a reading; also return the
    reflection [4, 4] of their world if that was left-handed, else None."""
    if not any(reading[:4]):
        return poses, None
    back, direction = np.linalg.inv(convention.frame), reading.direction or convention.direction
    matrices = back @ poses @ CAMERA_AXES[convention.axes]
    matrices = np.linalg.inv(matrices) if convention.direction == "w2c" else matrices
    if reading.order:
        x, y, z, w = Rotation.from_matrix(matrices[:, :3, :3]).as_quat().T
        meant = (w, x, y, z) if convention.order == "wxyz" else (y, z, w, x)
        matrices[:, :3, :3] = Rotation.from_quat(np.stack(meant, 1)).as_matrix()
    matrices = np.linalg.inv(matrices) if direction == "w2c" else matrices
    matrices = matrices @ CAMERA_AXES[reading.axes or convention.axes]
    mirrored = reading.axes == "left-handed" and bool(np.median(np.linalg.det(matrices)) < 0.0)
    world = convention.frame @ (MIRROR if mirrored else np.eye(4))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", TURNS.get(reading.turn, 0), degrees=True).as_matrix().round()
    return world @ matrices @ turn, world @ back if mirrored else None


def camera_as(camera: ColmapCamera, reading: Reading) -> ColmapCamera:
    """Convert a camera by a reading; one of 360-degree pictures has nothing to convert."""
    if not reading.intrinsics or camera.model == SPHERICAL_MODEL:
        return camera
    lens, params = camera.colmap, np.array(camera.params)
    if reading.intrinsics == NO_DISTORTION:
        return camera._replace(
            model="PINHOLE", params=(*lens.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),)
        )
    for indices in map(list, (lens.focal_length_idxs(), lens.principal_point_idxs())):
        order = -1 if reading.intrinsics == SWAPPED else 1
        params[indices] = params[indices][::order] * INTRINSICS[reading.intrinsics]
    return camera._replace(params=tuple(params.tolist()))


class Decision(NamedTuple):
    """Reading that the photographs ask for; None = none explains them."""

    reading: Reading | None
    share: float = 0.0  # of the matches that it explains, or that which explains most
    written: float = 0.0  # share as written
    own: float = 0.0  # share by the pairs' own poses
    worst: tuple[str, ...] = ()  # photographs whose matches are explained least


def decide(photographs: Sequence[Photograph], convention: Convention) -> Decision:
    """Find the reading by which the poses explain by far most of what pairs of photographs have in common; as written
    if there is too little of that, or a camera cannot be used."""
    from bitymi_ns.capture import two_views  # slow to import

    named, poses = readings(convention), np.stack([each.pose for each in photographs])
    written, cameras = named[WRITTEN], [each.camera for each in photographs]
    lenses = [camera.colmap for camera in dict.fromkeys(cameras)]
    focals = [value for lens in lenses for value in lens.params[lens.focal_length_idxs()]]
    usable = all(np.isfinite(lens.params).all() for lens in lenses) and min(focals, default=1.0) > 0.0
    pairs = two_views.match_pairs(photographs) if usable else []
    own, total = two_views.explained(pairs, two_views.rays_of(pairs, cameras)), sum(len(pair.x) for pair in pairs)
    if own.sum() < ENOUGH:
        return Decision(written)
    counts: dict[Reading, npt.NDArray[np.int64]] = {}
    for kinds in ([""], [*INTRINSICS, NO_DISTORTION]):
        for kind in kinds:
            rays = two_views.rays_of(pairs, [camera_as(camera, Reading(intrinsics=kind)) for camera in cameras])
            some = [each for each in named.values() if each.intrinsics == kind]
            counts |= {each: two_views.explained(pairs, rays, read_as(poses, convention, each)[0]) for each in some}
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
    photographs: Sequence[Photograph], convention: Convention, source: str, asked: str, need_photos: bool
) -> tuple[list[Photograph], Pose | None, str]:
    """Give photographs the poses and intrinsics of a reading, and say so.

    Args:
        asked: name of the reading; AUTO = the photographs decide, unless they are not needed and may be missing.

    Returns:
        photographs, the reflection [4, 4] of their world (None = none), and the reading's name.

    Raises:
        CaptureError: there is no such reading of this format.
    """
    named = readings(convention)
    if asked != AUTO and asked not in named:
        some = [name for name, each in named.items() if not each.intrinsics and sum(map(bool, each)) < 2]
        fail(f"--poses-as is {asked}, but {source} can be read as {AUTO}, {', '.join(some)}, or several joined by -.")
    decision = Decision(named.get(asked, named[WRITTEN]))
    if asked == AUTO and need_photos:
        files = [(each.file.name, each.file) for each in photographs]
        key = content_key(files, [(each.camera, each.pose.tolist(), str(each.mask)) for each in photographs])
        if key not in _decided:
            _decided[key] = decide(photographs, convention)
        decision = _decided[key]
        _report(decision, source)
    reading = decision.reading or named[WRITTEN]
    poses, world = read_as(np.stack([each.pose for each in photographs]), convention, reading)
    cameras = [camera_as(each.camera, reading) for each in photographs]
    pairs = zip(photographs, poses, cameras, strict=True)
    return [replace(each, pose=pose, camera=camera) for each, pose, camera in pairs], world, reading.name


def _report(decision: Decision, source: str) -> None:
    reading = decision.reading
    if reading is None:
        warn(
            f"{source}: the photographs contradict their poses, which explain {decision.written:.0%} of what pairs of "
            f"photographs have in common, where {decision.own:.0%} can be; least in {listed(decision.worst)}. "
            "`bitymi sfm` finds poses from the photographs."
        )
    elif any(reading):
        words = ", ".join(WORDS[part] for part in reading if part)
        warn(
            f"{source}: the poses are read as {words}: that explains {decision.share:.0%} of what pairs of photographs "
            f"have in common, as written {decision.written:.0%}. To keep what the file says: `bitymi-data --poses-as "
            f"{WRITTEN}`; this reading is `{reading.name}`."
        )
