"""Input and messages of the process that runs COLMAP."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from bitymi_ns.capture.camera import ColmapCamera

DATABASE = "database.db"
PAIRS = "pairs.txt"
MODEL = "model"  # names in the work folder: COLMAP's database, the pairs to match, and the resulting model

MAX_ERROR = 4.0
"""Observations farther off, in pixels of the images on which features were found, are dropped; COLMAP's own limit."""
SERIAL = 100
"""Number of photographs up to which one thread maps, so that runs are equal. For 50, two threads are no faster."""


class StageProgress(Protocol):
    """Receives the stage, its progress and total, and the database table whose rows count the progress from now on."""

    def __call__(self, stage: str, done: int, total: int, counts: str = "") -> None: ...


@dataclass(frozen=True)
class CameraGroup:
    """Photographs taken by one camera at one focal length."""

    camera: ColmapCamera  # in pixels of the photographs
    prior: bool  # True if the focal length is known, and not just an initial guess
    names: list[str]  # photographs, relative to the folder of images


@dataclass(frozen=True)
class Job:
    """Input of the process, in plain values for JSON."""

    work: str  # folder for the database and the model
    images: str
    """Folder of the photographs, or of links to them, with names without spaces, which separate entries of COLMAP's
    lists."""
    masks: str | None  # folder of masks named as COLMAP has it, of the size of the photographs
    cameras: list[CameraGroup]
    order: list[str]  # all photographs in the order of their times or names
    names: dict[str, str]  # names of the photographs in the resulting model
    sequence: bool  # True if neighbors in that order overlap, as frames of a video do
    positions: dict[str, list[float]]  # east, north and up in metres of photographs with GPS
    matching: str = "auto"
    mapper: str = "auto"
    opencv_if_better: bool = True
    max_image_size: int = 1600
    max_features: int = 8192
    poses: dict[str, list[list[float]]] = field(default_factory=dict)
    """World to camera [3,4] per photograph where they are known; points are triangulated then."""

    @property
    def threads(self) -> int:
        """Threads of what places cameras and points; -1 = all. Several add up in an order of their own, so that poses
        of equal photographs differ by rounding, and in time by more."""
        return 1 if len(self.order) <= SERIAL else -1

    @property
    def pixel(self) -> float:
        """Side of a pixel of the images on which features are found, in pixels of the photographs."""
        return max(1.0, max(max(group.camera.size) for group in self.cameras) / self.max_image_size)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder in the work folder, removed afterwards."""
        folder = Path(self.work) / "scratch"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def text(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def parse(text: str) -> Job:
        values = json.loads(text)
        values["cameras"] = [CameraGroup(ColmapCamera(*g["camera"]), g["prior"], g["names"]) for g in values["cameras"]]
        return Job(**values)


class NoPoses(Exception):
    """The photographs give no poses; the message says what to photograph differently."""
