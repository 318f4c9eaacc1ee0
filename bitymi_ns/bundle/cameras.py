"""cameras.json of a bundle: the cameras of the capture."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import torch
from pydantic import AfterValidator, BaseModel, Field, ValidationError
from torch import Tensor

from bitymi_ns.ranges import first_problem
from bitymi_ns.scene.camera import Camera
from . import strict_json
from .manifest import BundleError, Side

MOST_CAMERAS = 100_000
_Number = Annotated[float, Field(ge=-1e9, le=1e9)]

_Length = Annotated[float, Field(gt=0, le=1e9)]


def _gains_or_rows(numbers: list[float]) -> list[float]:
    if len(numbers) not in (3, 12):
        raise ValueError(f"must be 3 or 12 numbers, not {len(numbers)}")
    return numbers


class CapturedCamera(BaseModel):
    """A camera of the capture, and its photograph: size, focal lengths and principal point in pixels.

    `viewmat`: world to camera by rows, OpenCV axes. `photograph`: file of the bundle, possibly reduced. `correction`:
    maps colours of the scene, but not the background, to the photograph's: 3 gains, or matrix and offset [3, 4] by
    rows; None: mean exposure."""

    name: str
    held_out: bool
    width: Side
    height: Side
    fx: _Length
    fy: _Length
    cx: _Number
    cy: _Number
    viewmat: Annotated[list[_Number], Field(min_length=16, max_length=16)]
    photograph: str | None = None
    correction: Annotated[list[_Number], AfterValidator(_gains_or_rows)] | None = None

    @classmethod
    def of(
        cls, name: str, camera: Camera, held_out: bool, photograph: str | None = None, correction: Tensor | None = None
    ) -> "CapturedCamera":
        (fx, _, cx), (_, fy, cy), _ = camera.K.cpu().tolist()
        return cls(
            name=name,
            held_out=held_out,
            width=camera.width,
            height=camera.height,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            viewmat=camera.viewmat.cpu().flatten().tolist(),
            photograph=photograph,
            correction=None if correction is None else correction.cpu().flatten().tolist(),
        )

    @property
    def exposure(self) -> Tensor | None:
        """Convert the correction to gains [3] or matrix and offset [3, 4]."""
        if self.correction is None:
            return None
        numbers = torch.tensor(self.correction, dtype=torch.float32)
        return numbers if len(numbers) == 3 else numbers.view(3, 4)

    @property
    def camera(self) -> Camera:
        K = torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=torch.float32)
        return Camera(torch.tensor(self.viewmat, dtype=torch.float32).view(4, 4), K, self.width, self.height)


def cameras_data(cameras: Iterable[CapturedCamera]) -> bytes:
    rows = [camera.model_dump(exclude_none=True) for camera in cameras]
    return (json.dumps({"cameras": rows}) + "\n").encode()


def parse_cameras(data: bytes | bytearray, path: Path) -> list[CapturedCamera]:
    """Parse cameras.json. `path`: for messages. Raises BundleError: names the first bad entry."""
    try:
        value = strict_json.loads(data)
    except ValueError as error:
        raise BundleError(f"{path} cannot be read as JSON ({error})") from error
    entries = value.get("cameras") if isinstance(value, dict) else None
    if not isinstance(entries, list) or len(entries) > MOST_CAMERAS:
        raise BundleError(f"{path} must have a list cameras, of at most {MOST_CAMERAS:,}")
    rows = []
    for number, entry in enumerate(entries):
        try:
            rows.append(CapturedCamera.model_validate(entry))
        except ValidationError as error:
            where, what = first_problem(error)
            raise BundleError(f"{path}: {'.'.join(filter(None, (f'cameras.{number}', where)))}: {what}") from error
    return rows
