"""The poster of a bundle: a small picture of what a viewer shows first, there before the surfels are."""

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image, features

from bitymi_ns.scene.baked import BakedScene, as_bytes
from bitymi_ns.scene.camera import Camera

Pixels = npt.NDArray[np.uint8]

SIDE = 480  # pixels of its longer side, at most
SHARE = 0.02  # largest share of the bytes of surfels and texels
LEAST = 2048  # bytes that it may take however small these are
_QUALITIES = (80, 70, 60, 50, 40)
_SMALLER = 0.75
_SMALLEST = 16


def draw_poster(scene: BakedScene, camera: Camera, background: Sequence[float]) -> Pixels:
    """[H, W, 3] the scene, on the CPU, as the camera sees it, at most `SIDE` pixels along a side."""
    view = camera.to("cpu").within(SIDE)
    return as_bytes(scene.render(view, torch.tensor(background, dtype=torch.float32)).rgb).numpy()


def most_bytes(scene: int) -> int:
    """Bytes that a poster may take beside so many of surfels and texels."""
    return max(LEAST, int(SHARE * scene))


def encode_poster(pixels: Pixels, most: int) -> bytes | None:
    """A picture [H, W, 3] as lossy WebP of at most `most` bytes: the best quality that fits, or else fewer pixels.

    None where nothing fits, or where this machine's Pillow writes no WebP: a bundle can do without.
    """
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
