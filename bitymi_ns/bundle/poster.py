"""Poster of a bundle: a small picture of the viewer's first view, shown before the surfels are loaded."""

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image, features

from bitymi_ns.scene.baked import BakedScene, as_bytes
from bitymi_ns.scene.camera import Camera

Pixels = npt.NDArray[np.uint8]

SIDE = 480  # largest side, pixels
SHARE = 0.02  # largest size relative to surfels and texels
LEAST = 2048  # bytes that are always allowed
_QUALITIES = (80, 70, 60, 50, 40)
_SMALLER = 0.75
_SMALLEST = 16


def draw_poster(scene: BakedScene, camera: Camera, background: Sequence[float]) -> Pixels:
    """Render the scene, on the CPU, with at most `SIDE` pixels along a side: [H, W, 3]."""
    view = camera.to("cpu").within(SIDE)
    return as_bytes(scene.render(view, torch.tensor(background, dtype=torch.float32)).rgb).numpy()


def most_bytes(scene: int) -> int:
    """Compute the allowed bytes of a poster for a scene of `scene` bytes of surfels and texels."""
    return max(LEAST, int(SHARE * scene))


def encode_poster(pixels: Pixels, most: int) -> bytes | None:
    """Encode a picture [H, W, 3] as lossy WebP of at most `most` bytes: the best quality that fits, else fewer pixels.
    None: nothing fits, or this Pillow cannot write WebP."""
    if not features.check("webp"):
        return None
    image = Image.fromarray(pixels)
    while max(image.size) >= _SMALLEST:
        for quality in _QUALITIES:
            buffer = io.BytesIO()
            image.save(buffer, "WEBP", quality=quality, method=6)
            if buffer.tell() <= most:
                return buffer.getvalue()
        width, height = (max(1, round(_SMALLER * side)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
    return None
