"""What the process that runs COLMAP is told, and what it tells."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Protocol

DATABASE = "database.db"
PAIRS = "pairs.txt"
MODEL = "model"
"""Names within the folder of the work: COLMAP's database, the pairs to be compared, and the model that comes out."""

SERIAL = 100
"""Up to so many photographs cameras and points are placed by one thread. Of 50 photographs two take as long."""


class StageProgress(Protocol):
    """Gets the stage, how much of it is done, how much there is, and the table of the database whose rows say how much
    is done from now on."""

    def __call__(self, stage: str, done: int, total: int, counts: str = "") -> None: ...


@dataclass(frozen=True)
class CameraGroup:
    """Photographs taken by one camera at one focal length."""

    model: str
    width: int
    height: int
    params: list[float]
    """In COLMAP's order, pixels of the photographs."""
    prior: bool
    """Whether the focal length is known, and not just a first guess."""
    names: list[str]
    """Photographs, relative to the folder of images."""


@dataclass(frozen=True)
class Job:
    """Everything the process needs; plain values, so that it can be sent as JSON."""

    work: str
    """Folder for the database and the model."""
    images: str
    """Folder of the photographs, or of links to them. Their names here have no spaces, which COLMAP's lists part by."""
    masks: str | None
    """Folder of masks named as COLMAP has it, of the size of the photographs."""
    cameras: list[CameraGroup]
    order: list[str]
    """All photographs in the order of their times or names."""
    names: dict[str, str]
    """What each is called in the model that comes out."""
    sequence: bool
    """Whether it is known that neighbours in that order overlap, as frames of a video do."""
    positions: dict[str, list[float]]
    """East, north and up in metres of photographs with GPS."""
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

    def text(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def parse(text: str) -> Job:
        values = json.loads(text)
        values["cameras"] = [CameraGroup(**group) for group in values["cameras"]]
        return Job(**values)


class NoPoses(Exception):
    """The photographs give no poses; the message says what to photograph differently."""
