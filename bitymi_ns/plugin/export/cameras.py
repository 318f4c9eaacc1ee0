"""The capture's cameras as a file of the bundle, for viewers; and held-out photographs, if they may be given away."""

import io
from collections.abc import Sequence
from typing import Any

import torch
from PIL import Image

from bitymi_ns.bundle.cameras import CapturedCamera, cameras_data
from bitymi_ns.bundle.parts import CAMERAS
from bitymi_ns.scene.baked import as_bytes
from bitymi_ns.scene.camera import Camera

MOST_PIXELS = 1600  # longer side of a photograph in a bundle


def camera_files(datamanager: Any, train: Sequence[Camera], photographs: bool) -> dict[str, bytes]:
    """Make cameras.json, and the held-out photographs.

    Args:
        photographs: also the held-out photographs, as JPEG of at most `MOST_PIXELS` along a side.
    """
    files: dict[str, bytes] = {}
    names = [path.name for path in datamanager.train_dataset.image_filenames]
    rows = [CapturedCamera.of(name, camera, False) for name, camera in zip(names, train, strict=True)]
    for i, path in enumerate(datamanager.eval_dataset.image_filenames):
        view = datamanager.eval_views[i]
        photograph = f"photograph-{i + 1:04d}.jpg" if photographs else None
        if photograph is not None:
            files[photograph] = _jpeg(view.target(torch.zeros(3), "cpu"))
        rows.append(CapturedCamera.of(path.name, view.camera, True, photograph))
    return {CAMERAS: cameras_data(rows), **files}


def _jpeg(image: torch.Tensor) -> bytes:
    picture = Image.fromarray(as_bytes(image).numpy())
    picture.thumbnail((MOST_PIXELS, MOST_PIXELS), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=88)
    return buffer.getvalue()
