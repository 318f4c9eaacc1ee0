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
INTRINSICS = {f"intrinsics{factor:g}": factor for factor in (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)}
SWAPPED = "swapped-intrinsics"
WORDS = {
    "opengl": "in OpenGL's camera axes (y up, z backward)", "opencv": "in OpenCV's camera axes (y down, z forward)",
    "left-handed": "left-handed, as Unity's", "c2w": "camera to world", "w2c": "world to camera",
    "wxyz": "with quaternions in the order w, x, y, z", "xyzw": "with quaternions in the order x, y, z, w",
    **{name: f"turned by {angle} degrees about the optical axis" for name, angle in TURNS.items()},
    **{name: f"with intrinsics for pictures {1 / factor:g} times as large" for name, factor in INTRINSICS.items()},
    SWAPPED: "with intrinsics for pictures whose sides are swapped",
}  # fmt: skip
"""Parts of the names of readings, and what they say of poses."""
ENOUGH = 100  # matches that decide
FITS = 0.5  # least share of the matches that poses explain, relative to what the pairs' own poses explain
LEAD = 2.0
"""Least ratio of what a reading explains to what the poses explain as written; in captures that are right as written it
is at most 0.4, in others at least 7."""
WORST = 0.1  # share relative to the pairs' own below which a photograph is named


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
    every = product(axes, others(convention.direction, "c2w", "w2c"), orders, ["", *TURNS], ["", *INTRINSICS, SWAPPED])
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
    """Convert a camera by a reading."""
    if not reading.intrinsics or camera.model == SPHERICAL_MODEL:
        return camera
    if factor := INTRINSICS.get(reading.intrinsics):
        scaled = camera.colmap
        scaled.rescale(factor)
        return camera._replace(params=tuple(scaled.params))
    params = np.array(camera.params)
    for indices in (camera.colmap.focal_length_idxs(), camera.colmap.principal_point_idxs()):
        params[list(indices)] = params[list(indices)][::-1]
    return camera._replace(params=tuple(params.tolist()))


class Decision(NamedTuple):
    """Reading that the photographs ask for; None = none explains them."""

    reading: Reading | None
    share: float = 0.0  # of the matches that it explains
    written: float = 0.0  # share as written
    own: float = 0.0  # share by the pairs' own poses
    worst: tuple[str, ...] = ()  # photographs whose pairs are explained least
    undistorted: bool = False  # the poses fit without the distortion of the lens


def decide(photographs: Sequence[Photograph], convention: Convention) -> Decision:
    """Find the reading by which the photographs' poses explain by far most of what pairs of them have in common; as
    written if there is too little of that, or a camera cannot be used."""
    from bitymi_ns.capture import two_views  # slow to import

    named = readings(convention)
    as_written, cameras = Decision(named[WRITTEN]), [each.camera for each in photographs]
    lenses = [camera.colmap for camera in dict.fromkeys(cameras)]
    if not all(
        np.isfinite(lens.params).all() and (lens.params[lens.focal_length_idxs()] > 0.0).all() for lens in lenses
    ):
        return as_written
    pairs = two_views.match_pairs(photographs)
    own = two_views.explained(pairs, two_views.rays_of(pairs, cameras))
    if own.sum() < ENOUGH:
        return as_written
    poses, total = np.stack([each.pose for each in photographs]), sum(len(pair.x) for pair in pairs)

    def explained(every: Sequence[Reading], cameras: Sequence[ColmapCamera]) -> dict[Reading, npt.NDArray[np.int64]]:
        """Count the matches that readings of one kind of intrinsics explain."""
        seen = two_views.rays_of(pairs, [camera_as(camera, every[0]) for camera in cameras])
        return {each: two_views.explained(pairs, seen, read_as(poses, convention, each)[0]) for each in every}

    def best(counts: dict[Reading, npt.NDArray[np.int64]]) -> Decision:
        """Choose the reading that explains most; it is far ahead, or as written."""
        most = max(counts, key=lambda each: counts[each].sum())
        share, least = counts[most].sum() / total, FITS * own.sum() / total
        ahead = share >= max(least, LEAD * written.sum() / total)
        fits = written.sum() / total >= least
        reading = most if ahead else named[WRITTEN] if fits else None
        return Decision(reading, float(share), float(written.sum() / total), float(own.sum() / total))

    kinds = {kind: [each for each in named.values() if each.intrinsics == kind] for kind in ("", *INTRINSICS, SWAPPED)}
    counts = explained(kinds[""], cameras)
    written = counts[named[WRITTEN]]
    decision = best(counts)
    if decision.reading is not None:
        return decision
    for kind, every in kinds.items():
        counts |= explained(every, cameras) if kind else {}
    decision = best(counts)
    if decision.reading is not None:
        return decision
    straight = [camera._replace(model="PINHOLE", params=tuple(camera.colmap.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()))
                for camera in cameras if camera.model != SPHERICAL_MODEL]  # fmt: skip
    fits = len(straight) == len(cameras) and best(explained([named[WRITTEN]], straight)).reading is not None
    sums = np.zeros((2, len(photographs)))
    for pair, *both in zip(pairs, written, own, strict=True):
        for i in (pair.first, pair.second):
            sums[:, i] += both
    worst = [photographs[i].file.name for i in np.argsort(sums[0] / np.maximum(sums[1], 1e-9)) if sums[1, i]]
    return decision._replace(worst=tuple(worst[:3]), undistorted=fits)


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
        remedy = "Poses found from the photographs: `bitymi sfm`."
        if decision.undistorted:
            remedy = "They fit without the lens distortion: set its coefficients to 0."
        warn(
            f"{source}: the photographs contradict their poses, which explain {decision.written:.0%} of what pairs of "
            f"photographs have in common, where {decision.own:.0%} can be; least in {listed(decision.worst)}. {remedy}"
        )
    elif any(reading):
        words = ", ".join(WORDS[part] for part in reading if part)
        warn(
            f"{source}: the poses are read as {words}: that explains {decision.share:.0%} of what pairs of photographs "
            f"have in common, as written {decision.written:.0%}. To keep what the file says: `bitymi-data --poses-as "
            f"{WRITTEN}`; this reading is `{reading.name}`."
        )
