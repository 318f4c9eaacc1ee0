"""Whether the poses of a capture go with its points, or would in another convention than that of their file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bitymi_ns.plugin.console import warn
from bitymi_ns.plugin.data.images import read_image
from bitymi_ns.plugin.data.ply import Points
from bitymi_ns.plugin.data.point_colors import sampled
from bitymi_ns.plugin.data.views import OPENCV_AXES, Photograph
from bitymi_ns.train.views import spread

Pose = npt.NDArray[np.float64]
LOOKED_AT = 8
"""Photographs, spread over all, into which points are projected."""
POINTS = 2000
LONGER_SIDE = 800
"""Pixels at least, to which large JPEG files are reduced as they are decoded."""
NOTHING, SOMETHING = 0.01, 0.1
"""Share of the points that a picture shows by poses that are wrong, and by such as may be right."""
MANY_TIMES, MORE_ALIKE = 2.5, 0.05
"""Poses that show so many times as many points, which are that much more like the picture in their place by the
correlation of brightness, are the right ones. In three real captures the right ones show 70 to 76 % of the points with
0.21 to 0.56, all others at most 24 % with 0.12."""
ALIKE = 0.4
"""So much more alike, poses are the right ones however few points they show: a room has points on all sides."""


def _other_order(pose: Pose) -> Pose:
    """Camera to world of a COLMAP model whose quaternions are x, y, z, w, from what it is read as."""
    written = np.linalg.inv(pose @ OPENCV_AXES)
    meant = np.eye(4)
    # read as w, x, y, z; SciPy's order is x, y, z, w
    meant[:3, :3] = Rotation.from_quat(Rotation.from_matrix(written[:3, :3]).as_quat()[[3, 0, 1, 2]]).as_matrix()
    meant[:3, 3] = written[:3, 3]
    return np.linalg.inv(meant) @ OPENCV_AXES


JSON: dict[str, Callable[[Pose], Pose]] = {
    "the cameras have OpenCV's axes (y down, z forward): negate the second and third column": lambda pose: (
        pose @ OPENCV_AXES
    ),
    "they are world to camera: invert them": np.linalg.inv,
    "they are world to camera with OpenCV's axes: invert them, then negate the second and third column": lambda pose: (
        np.linalg.inv(pose) @ OPENCV_AXES
    ),
    "they are left-handed, as Unity's: negate the third column": lambda pose: pose @ np.diag([1.0, 1.0, -1.0, 1.0]),
}
"""What a matrix of a transforms.json, which should be camera to world with OpenGL's axes, may be; and what it then
means."""
COLMAP: dict[str, Callable[[Pose], Pose]] = {
    "the cameras have OpenGL's axes (y up, z backward)": lambda pose: pose @ OPENCV_AXES,
    "they are camera to world: invert them": lambda pose: OPENCV_AXES @ np.linalg.inv(pose) @ OPENCV_AXES,
    "they are camera to world with OpenGL's axes": lambda pose: OPENCV_AXES @ np.linalg.inv(pose),
    "the quaternions are in the order x, y, z, w: write w first": _other_order,
}
"""The same for a COLMAP model, whose poses should be world to camera with OpenCV's axes."""


class _Fit(NamedTuple):
    """How well points go with photographs: the share of them that is in a picture, and the correlation of their
    brightness with that of the picture; 0 where they have no colours."""

    share: float
    likeness: float


def check_conventions(
    points: Points,
    photographs: Sequence[Photograph],
    others: dict[str, Callable[[Pose], Pose]],
    where: str,
    frame: Pose | None = None,
) -> None:
    """Warn where the points are not seen by the poses as they are read, but would be by another convention.

    Args:
        points: in the frame of the poses.
        photographs: with their poses.
        others: `JSON` or `COLMAP`.
        where: the poses are from, for messages.
        frame: [4, 4] from the frame in which the poses were written to that of the photographs; None = the same.
    """
    rgb = points.rgb if len(points.rgb) == len(points.xyz) else np.zeros((len(points.xyz), 3), np.uint8)
    kept = np.flatnonzero(np.isfinite(points.xyz).all(1))
    kept = kept[:: max(1, len(kept) // POINTS)]
    if len(kept) < 20:
        return
    back = np.eye(4) if frame is None else np.linalg.inv(frame)
    xyz = points.xyz[kept] @ back[:3, :3].T + back[:3, 3]
    chosen = [photographs[i] for i in spread(len(photographs), LOOKED_AT)]
    pictures = [_picture(photograph) for photograph in chosen]

    def fit(convention: Callable[[Pose], Pose]) -> _Fit:
        cameras = [replace(each, pose=convention(back @ each.pose)) for each in chosen]
        found = [sampled(xyz, *each) for each in zip(cameras, pictures, strict=True)]
        return _fit(rgb[kept].astype(float), np.stack(found))

    read = fit(lambda pose: pose)
    fits = {name: fit(convention) for name, convention in others.items()}
    best = max(fits, key=lambda name: fits[name].share * max(fits[name].likeness, NOTHING))
    better = fits[best].likeness - read.likeness
    unseen = read.share < NOTHING and fits[best].share > SOMETHING
    rare = fits[best].share > max(SOMETHING, MANY_TIMES * read.share) and better > MORE_ALIKE
    if unseen or rare or (fits[best].share > NOTHING and fits[best].likeness > ALIKE and better > ALIKE):
        what = "are in next to none of the photographs" if unseen else "do not look like the photographs in their place"
        warn(
            f"{where}: by its poses its points {what}; they would if the poses were written in another convention: "
            f"{best}. As they are, the scene will be wrong."
        )


def _picture(photograph: Photograph) -> npt.NDArray[np.uint8]:
    camera = photograph.camera
    scale = LONGER_SIDE / max(camera.width, camera.height)
    wanted = (round(camera.width * scale), round(camera.height * scale)) if scale < 1.0 else None
    return np.asarray(read_image(photograph.file, wanted=wanted).convert("RGB"))


def _fit(rgb: npt.NDArray[np.float64], seen: npt.NDArray[np.float32]) -> _Fit:
    """Of colours [N, 3] and those in pictures [M, N, 3], NaN where a point is in none."""
    inside = np.isfinite(seen[..., 0])
    share = float(inside.mean())
    own, theirs = np.broadcast_to(rgb.mean(-1), inside.shape)[inside], seen.mean(-1)[inside]
    if len(own) < 20 or own.std() < 1.0 or theirs.std() < 1.0:
        return _Fit(share, 0.0)
    return _Fit(share, float(np.corrcoef(own, theirs)[0, 1]))
