"""Input and messages of COLMAP's process."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from pydantic import TypeAdapter

from ..cache import emptied
from ..types import ColmapCamera

DATABASE = "database.db"
PAIRS = "pairs.txt"
MODEL = "model"  # in the work folder

MAX_ERROR = 4.0  # of observations, in pixels of the images with features; COLMAP's own limit
SERIAL = 100  # most photographs that one thread maps, for equal results; for 50, two are no faster


class StageProgress(Protocol):
    """Receiver of the stage, its progress and total, and the database table whose rows count the progress from then."""

    def __call__(self, stage: str, done: int, total: int, counts: str = "") -> None: ...


@dataclass(frozen=True)
class CameraGroup:
    """Photographs of one camera at one focal length."""

    camera: ColmapCamera  # in pixels of the photographs
    prior: bool  # the focal length is known
    names: list[str]  # photographs, relative to the folder of images


@dataclass(frozen=True)
class Job:
    """Input of the process, in plain values for JSON."""

    work: str  # folder for the database and the model
    images: str
    """Folder of the photographs, or of links to them; spaces in names would separate entries of COLMAP's lists."""
    masks: str | None  # folder of masks by COLMAP's names, of the size of the photographs
    cameras: list[CameraGroup]
    order: list[str]  # all photographs by time or name
    names: dict[str, str]  # of the photographs in the resulting model
    sequence: bool = False  # neighbors in that order overlap, as frames of a video
    positions: dict[str, list[float]] = field(default_factory=dict)  # east, north and up in metres, by GPS
    matching: str = "auto"
    mapper: str = "auto"
    opencv_if_better: bool = True
    max_image_size: int = 1600
    max_features: int = 8192
    poses: dict[str, list[list[float]]] = field(default_factory=dict)
    """World to camera [3,4] per photograph, if known: triangulate points then."""

    @property
    def threads(self) -> int:
        """Threads for mapping and triangulation; -1 = all. Several sum in varying order, and poses differ."""
        return 1 if len(self.order) <= SERIAL else -1

    @property
    def pixel(self) -> float:
        """Side of a pixel of the images with features, in pixels of the photographs."""
        return max(1.0, max(max(group.camera.size) for group in self.cameras) / self.max_image_size)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Make an empty folder in the work folder, and remove it afterwards."""
        folder = emptied(Path(self.work) / "scratch")
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def text(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def parse(text: str) -> Job:
        return TypeAdapter(Job).validate_json(text)


class NoPoses(Exception):
    """There are no poses; the message says what to do."""
