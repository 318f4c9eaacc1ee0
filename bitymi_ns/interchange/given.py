"""The cameras that a bundle has with it, and the held-out photographs, where it has these."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from PIL import Image
from pydantic import BaseModel, Field, ValidationError

from bitymi_ns.bundle import BundleError, archive
from bitymi_ns.bundle.manifest import Manifest, check_file_name
from bitymi_ns.bundle.read import check_bytes
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View

CAMERAS = "cameras.json"
_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Size = Annotated[int, Field(ge=1, le=1 << 20)]


class _Row(BaseModel):
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

    def camera(self) -> Camera:
        K = torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        return Camera(torch.tensor(self.viewmat).view(4, 4), K, self.width, self.height)


class _File(BaseModel):
    cameras: list[_Row]


@dataclass(frozen=True)
class Given:
    """What is known of a bundle's capture.

    Attributes:
        train: the training cameras.
        held_out: photographs that training did not see, with their cameras.
    """

    train: list[Camera] = field(default_factory=list)
    held_out: list[View] = field(default_factory=list)


class NamedCamera(NamedTuple):
    """A camera of a capture: the name of its photograph, whether that was held out, and the camera."""

    name: str
    held_out: bool
    camera: Camera


def given_with(folder: str | Path, info: Manifest) -> Given:
    """What cameras.json of a bundle says, and the photographs that it names; nothing, where it has no such file.

    Args:
        folder: the bundle's folder, or its one file.
        info: bundle.json.

    Raises:
        BundleError: a file is missing, altered or malformed.
    """
    folder = Path(folder)
    rows = _rows(folder, info)
    held_out = [_view(folder, info, row) for row in rows if row.held_out and row.photograph is not None]
    return Given([row.camera() for row in rows if not row.held_out], held_out)


def named_cameras(folder: str | Path, info: Manifest) -> list[NamedCamera]:
    """The cameras of the capture that a bundle was made of, as cameras.json has them; see `given_with`."""
    return [NamedCamera(row.name, row.held_out, row.camera()) for row in _rows(Path(folder), info)]


def _rows(folder: Path, info: Manifest) -> list[_Row]:
    if CAMERAS not in info.files:
        return []
    try:
        return _File.model_validate_json(_bytes(folder, info, CAMERAS)).cameras
    except ValidationError as error:
        first = error.errors()[0]
        raise BundleError(f"{folder / CAMERAS}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _view(folder: Path, info: Manifest, row: _Row) -> View:
    """A photograph, which may be smaller than its camera's image."""
    name, camera = row.photograph or "", row.camera()
    check_file_name(name, CAMERAS)
    if name not in info.files:
        raise BundleError(f"{folder / CAMERAS} names the photograph {name}, which is no file of the bundle")
    try:
        picture = torch.from_numpy(np.array(Image.open(io.BytesIO(_bytes(folder, info, name))).convert("RGB")))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise BundleError(f"{folder / name} cannot be read as a picture: {error}") from error
    height, width = picture.shape[:2]
    K = torch.diag(torch.tensor([width / camera.width, height / camera.height, 1.0])) @ camera.K
    return View(Camera(camera.viewmat, K, width, height), picture)


def _bytes(folder: Path, info: Manifest, name: str) -> bytes:
    path = folder / name
    try:
        if folder.is_file():
            with archive.opened(folder, str(folder)) as parts:
                data = parts.part(name, info.files[name].bytes)
        else:
            data = path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error}") from error
    check_bytes(path, info, name, data)
    return data
