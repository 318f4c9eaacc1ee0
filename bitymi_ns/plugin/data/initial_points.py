"""The points that training starts from: those of the capture, triangulated ones, or random ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Literal

import numpy as np

from bitymi_ns.capture.types import CaptureError
from bitymi_ns.plugin.console import say, warn
from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.plugin.data.lens import rescaled
from bitymi_ns.plugin.data.ply import Points
from bitymi_ns.plugin.data.views import OPENCV_AXES, Photograph, size_of

Choice = Literal["auto", "triangulate", "random"]
"""auto = those of the capture, triangulated ones where it has none; triangulate = in any case; random = in any case."""
MIRROR = np.diag([1.0, 1.0, -1.0])

_wanted: ContextVar[bool] = ContextVar("points are wanted", default=False)


@contextmanager
def for_a_new_scene(wanted: bool) -> Iterator[None]:
    """While it lasts, captures are read for a scene that starts from points, if that is wanted. Evaluation and the
    viewer read them for a scene that is there already: no time is spent on points."""
    token = _wanted.set(wanted)
    try:
        yield
    finally:
        _wanted.reset(token)


def are_wanted() -> bool:
    """Whether the capture is read for a scene that starts from points."""
    return _wanted.get()


def starting_points(
    own: Points | None, choice: Choice, photographs: Sequence[Photograph], home: Path, where: str
) -> Points | None:
    """The points to start from; None = random ones.

    Args:
        own: those of the capture; None = it has none.
        choice: which are wanted.
        photographs: of which points are triangulated.
        home: folder of the capture, where triangulated points are kept.
        where: the poses are from, for messages.
    """
    if choice == "random":
        return None
    if own is not None and len(own.xyz) and choice == "auto":
        return own
    return triangulated(photographs, home, where) if are_wanted() else None


def triangulated(photographs: Sequence[Photograph], home: Path, where: str) -> Points | None:
    """Points triangulated from the photographs by their poses; None = it is not possible, which is said."""
    from bitymi_ns.capture import KnownView, triangulate  # late: it is much, and seldom needed
    from bitymi_ns.progress import rich_progress

    middle = np.mean([photograph.pose[:3, 3] for photograph in photographs], axis=0)
    mirrored = [bool(np.linalg.det(photograph.pose[:3, :3]) < 0.0) for photograph in photographs]
    mirror = MIRROR if all(mirrored) else np.eye(3)  # the photographs of a mirrored capture are not mirrored
    views = []
    for photograph in photographs:
        camera = photograph.camera
        size = (camera.width, camera.height)
        stored = (size_of(photograph.file) or size) if photograph.smaller else size
        c2w = photograph.pose @ OPENCV_AXES
        turn = (mirror @ c2w[:3, :3]).T
        shift = -turn @ mirror @ (c2w[:3, 3] - middle)
        params = rescaled(camera.model, camera.params, size, stored)
        pose = np.column_stack([turn, shift])
        views.append(KnownView(photograph.file, camera.model, *stored, params, pose, photograph.mask))
    say(f"{where} has no points: they are triangulated from the photographs, once. --points random does without.")
    try:
        if any(mirrored) and not all(mirrored):
            raise CaptureError("some poses are mirrored against the others")
        with rich_progress() as progress:
            model = read_model(triangulate(home, views, progress, warn))
    except CaptureError as error:
        warn(f"No points can be triangulated: {error}. Training starts from random points.")
        return None
    say(f"{len(model.xyz):,} points have been triangulated; they are kept for later runs.")
    return Points(model.xyz @ mirror + middle, model.rgb)
