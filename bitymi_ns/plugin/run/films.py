"""Write films as H.264 in MP4, by PyAV, and pictures, whole or not at all."""

import gzip
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path, PosixPath
from typing import IO, Any

import numpy as np
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from bitymi_ns.capture.kinds import RENDERED
from bitymi_ns.files import complete_file, complete_folder, write_file
from bitymi_ns.scene.baked import as_bytes
from ..console import fail

RATES = (0.01, 1000.0)  # frames per second
QUALITY = "18"  # constant rate factor: hardly visible loss
ENDINGS = {"jpeg": ".jpg", "png": ".png"}
FRAME = re.compile(r"\d{5}\.(jpg|png)")

Add = Callable[[np.ndarray], None]
"""Function that receives the next frame: [H, W, 3], or [H, W, 4] where the format has transparency, uint8."""


@contextmanager
def film(path: Path, fps: float) -> Iterator[Add]:
    """Open a film for all browsers: 8 bits, yuv420p of BT.709, index in front; it replaces an earlier one at the end.
    Odd sizes lose the last row or column. Raises InputError: the size does not suit H.264; OSError: it cannot be
    written."""
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    stream: Any = None
    standard = {"dst_colorspace": Colorspace.ITU709, "dst_color_range": ColorRange.MPEG}

    def add(image: np.ndarray) -> None:
        nonlocal stream
        height, width = (size - size % 2 for size in image.shape[:2])
        if stream is None:
            rate = Fraction(fps).limit_denominator(1001)  # as 24000/1001
            stream = container.add_stream("libx264", rate=rate, options={"crf": QUALITY})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            context = stream.codec_context
            context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
            context.color_primaries = ColorPrimaries.BT709
            context.color_trc = ColorTrc.BT709
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), "rgb24")
        container.mux(stream.encode(frame.reformat(format="yuv420p", **standard)))

    mp4: Any = {"format": "mp4", "options": {"movflags": "+faststart"}}
    with complete_file(path, follow=True) as file, av.open(os.path.abspath(file.name), "w", **mp4) as container:
        container.metadata["comment"] = RENDERED.decode()
        try:
            yield add
            container.mux(stream.encode())
        except av.FFmpegError as error:
            if isinstance(error, OSError) and error.errno:
                raise OSError(error.errno, error.strerror) from error
            fail(f"{path}: H.264 cannot encode it ({error}). Choose another size, or --output-format images.", error)


@contextmanager
def frames(folder: Path, form: str, quality: int) -> Iterator[Add]:
    """Open a folder of pictures 00000.jpg, 00001.jpg and so on, or .png; it replaces a folder of frames at the end.
    Raises InputError: the folder holds other files; OSError: it cannot be written."""
    count = 0

    def add(image: np.ndarray) -> None:
        nonlocal count
        with open(new / f"{count:05d}{ENDINGS[form]}", "wb") as file:
            _save(file, image, form, quality)
        count += 1

    with complete_folder(folder, lambda: check_frames(folder)) as new:
        yield add


def check_frames(folder: Path) -> None:
    """Stop if a folder holds other files than frames."""
    if folder.is_dir() and not all(FRAME.fullmatch(path.name) for path in folder.iterdir()):
        fail(f"{folder} holds other files than frames and is not replaced: choose another --output-path.")


def write_image(path: Path, image: np.ndarray, *, fmt: str, quality: int = 100) -> None:
    """Write a picture [H, W, 3 or 4], float in [0, 1] or uint8, as mediapy's function does."""
    if image.dtype != np.uint8:
        image = as_bytes(torch.from_numpy(image)).numpy()
    with complete_file(Path(path)) as file:
        _save(file, image, fmt, quality)


def _save(file: IO[bytes], image: np.ndarray, form: str, quality: int) -> None:
    encoded = io.BytesIO()  # Pillow hides why writing fails
    picture = Image.fromarray(image)
    if form == "jpeg":
        picture.save(encoded, form, quality=quality, comment=RENDERED)
    else:
        text = PngInfo()
        text.add_text("Comment", RENDERED.decode())
        picture.save(encoded, form, pnginfo=text)
    file.write(encoded.getbuffer())


class WholeText(PosixPath):
    """Path for ns-eval that writes text whole or not at all."""

    def write_text(self, data: str, encoding: str | None = None, *options: Any) -> int:
        write_file(Path(self), data.encode(encoding or "utf8"), follow=True)
        return len(data)


@contextmanager
def open_gzip(path: Path, mode: str) -> Iterator[gzip.GzipFile]:
    """Open a compressed file for writing, as gzip's function does."""
    with complete_file(Path(path)) as file, gzip.GzipFile(fileobj=file, mode="wb", mtime=0) as compressed:
        yield compressed
