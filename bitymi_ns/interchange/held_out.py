"""Held-out photographs stored in a bundle."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from bitymi_ns.bundle import Bundle, BundleError
from bitymi_ns.bundle.cameras import CapturedCamera
from bitymi_ns.bundle.manifest import Manifest, check_file_name
from bitymi_ns.bundle.parts import CAMERAS, Parts, parts_of
from bitymi_ns.bundle.read import read_file
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View

PICTURES = ("JPEG", "PNG", "WEBP")  # Pillow's names of the photographs' formats


def training_cameras(bundle: Bundle) -> Sequence[Camera]:
    """List the cameras of the training photographs; empty if the bundle has no cameras.json."""
    return [row.camera for row in bundle.cameras if not row.held_out]


def read_held_out(folder: str | Path, bundle: Bundle) -> list[View]:
    """Read the held-out photographs of a bundle with their cameras; empty if it has none.

    Args:
        folder: the bundle's folder, or its .bitymi file.

    Raises:
        BundleError: a photograph is missing, altered or no image.
    """
    with parts_of(folder) as parts:
        rows = [row for row in bundle.cameras if row.held_out and row.photograph is not None]
        return [_view(parts, bundle.info, row) for row in rows]


def _view(parts: Parts, info: Manifest, row: CapturedCamera) -> View:
    """Read a photograph and scale its camera to it: photographs may be stored smaller."""
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
