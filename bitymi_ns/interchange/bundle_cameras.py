"""Cameras of a bundle's capture (cameras.json), and the held-out photographs, where it has these."""

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from PIL import Image
from pydantic import BaseModel, Field, ValidationError

from bitymi_ns.bundle import BundleError, strict_json
from bitymi_ns.bundle.manifest import Manifest, check_file_name
from bitymi_ns.bundle.parts import CAMERAS, Parts, parts_of
from bitymi_ns.bundle.read import read_file
from bitymi_ns.ranges import first_problem
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View

PICTURES = ("JPEG", "PNG", "WEBP")  # formats of photographs, as Pillow names them
_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Size = Annotated[int, Field(ge=1, le=1 << 20)]


class CameraRow(BaseModel):
    """A camera of a capture: the name of its photograph, whether that was held out, and the camera."""

    name: str
    held_out: bool
    width: _Size
    height: _Size
    fx: Annotated[float, Field(gt=0, le=1e9)]
    fy: Annotated[float, Field(gt=0, le=1e9)]
    cx: _Number
    cy: _Number
    viewmat: Annotated[list[_Number], Field(min_length=16, max_length=16)]
    photograph: str | None = None

    @property
    def camera(self) -> Camera:
        """Camera of the view."""
        K = torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        return Camera(torch.tensor(self.viewmat).view(4, 4), K, self.width, self.height)


def camera_row(name: str, camera: Camera, held_out: bool) -> dict[str, Any]:
    """One camera of cameras.json: intrinsics in pixels, viewmat [16] by rows (world to camera, OpenCV axes)."""
    K = camera.K.cpu().tolist()
    return {
        "name": name,
        "held_out": held_out,
        "width": camera.width,
        "height": camera.height,
        **{"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]},
        "viewmat": camera.viewmat.cpu().flatten().tolist(),
    }


MOST_CAMERAS = 100_000


@dataclass(frozen=True)
class BundleCameras:
    """Cameras of the capture that a bundle was made of."""

    train: list[Camera] = field(default_factory=list)  # the training cameras
    held_out: list[View] = field(default_factory=list)  # photographs that training did not see, with their cameras


def read_cameras(folder: str | Path, info: Manifest) -> BundleCameras:
    """Read cameras.json of a bundle and the photographs that it names; empty where there is no such file.

    Args:
        folder: the bundle's folder, or its one file.

    Raises:
        BundleError: a file is missing, altered or malformed.
    """
    if CAMERAS not in info.files:
        return BundleCameras()
    with parts_of(folder) as parts:
        rows = _rows(parts, info)
        held_out = [_view(parts, info, row) for row in rows if row.held_out and row.photograph is not None]
    return BundleCameras([row.camera for row in rows if not row.held_out], held_out)


def named_cameras(folder: str | Path, info: Manifest) -> list[CameraRow]:
    """The cameras of the capture that a bundle was made of, as cameras.json has them; see `read_cameras`."""
    if CAMERAS not in info.files:
        return []
    with parts_of(folder) as parts:
        return _rows(parts, info)


def _rows(parts: Parts, info: Manifest) -> list[CameraRow]:
    """Rows of cameras.json; the first malformed one is refused."""
    path = parts.bundle / CAMERAS
    try:
        value = strict_json.loads(read_file(parts, info, CAMERAS))
    except ValueError as error:
        raise BundleError(f"{path} cannot be read as JSON ({error})") from error
    found = value.get("cameras") if isinstance(value, dict) else None
    if not isinstance(found, list) or len(found) > MOST_CAMERAS:
        raise BundleError(f"{path} must have a list cameras, of at most {MOST_CAMERAS:,}")
    rows = []
    for number, row in enumerate(found):
        try:
            rows.append(CameraRow.model_validate(row))
        except ValidationError as error:
            where, what = first_problem(error)
            raise BundleError(f"{path}: {'.'.join(filter(None, (f'cameras.{number}', where)))}: {what}") from error
    return rows


def _view(parts: Parts, info: Manifest, row: CameraRow) -> View:
    """A photograph, which may be smaller than its camera's image."""
    name, camera = row.photograph or "", row.camera
    check_file_name(name, CAMERAS)
    if name not in info.files:
        raise BundleError(f"{parts.bundle / CAMERAS} names the photograph {name}, which is no file of the bundle")
    try:
        stored = Image.open(io.BytesIO(read_file(parts, info, name)), formats=PICTURES)
        picture = torch.from_numpy(np.array(stored.convert("RGB")))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise BundleError(f"{parts.bundle / name} cannot be read as a picture: {error}") from error
    height, width = picture.shape[:2]
    K = torch.diag(torch.tensor([width / camera.width, height / camera.height, 1.0])) @ camera.K
    return View(Camera(camera.viewmat, K, width, height), picture)
