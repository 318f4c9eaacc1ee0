"""Frames of a video: the sharpest of each stretch of equal camera motion."""

import math
import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import av
import numpy as np
from PIL import Image

from bitymi_ns.capture.cache import content_key, finished, work_folder
from bitymi_ns.capture.hdr import is_hdr, tone_mapped
from bitymi_ns.capture.photos import sharpness
from bitymi_ns.capture.prepare import IMAGES, JPEG_QUALITY
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import Tell, complete_folder, explained, write_file
from bitymi_ns.progress import Progress
from bitymi_ns.reading import open_regular

DONE = "frames"  # file that is written when all frames are
SMALL = 160  # longer side of frames for measuring motion, pixels
FINE = 640  # longer side of frames for measuring sharpness, pixels
STRIDE = 0.08  # motion between extracted frames, in units of the longer side: neighbors share about 90 %
FEWEST, MOST = 20, 300  # number of frames of a video whose camera moves at all
STILL = 0.02  # motion over the whole video, in units of the longer side, below which the camera stood still
PER_SECOND = 15  # frames surveyed per second by their timestamps: phones film at a rate that varies with the light
TRUSTED = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,mpegvideo",
    "protocol_whitelist": "file",
}
"""FFmpeg options: a file of any name may be a list of other files and URLs, which would be read."""
LEAST_SURVEYED = 60  # frames surveyed at least, where there are so many: all of a clip of a second or two


def frames_with_poses(video: Path, poses: int, progress: Progress, tell: Tell) -> Path:
    """Write the frames of a video whose camera is known, as they are stored; see `extract_frames`. They are kept beside
    the video.

    Args:
        poses: number of frames with a pose.

    Raises:
        CaptureError: it cannot be read, or has another number of frames.
    """
    key = content_key([(video.name, video)], "frames")
    done = finished(video.parent, key, DONE, "frames")
    if done is not None:
        return done / IMAGES
    total = _pace(video)[2]
    if abs(total - poses) > max(2, poses // 100):
        raise CaptureError(
            f"{video} has {total} frames, but {poses} poses: which belong together is unknown. Export the capture "
            f"again, or have poses computed: `bitymi-data --data {video}`"
        )
    with work_folder(video.parent, key, tell, "frames") as work:
        with explained(work, CaptureError):
            extract_frames(video, work, None, progress, upright=False)
            write_file(work / DONE, b"")
        return work / IMAGES


def extract_frames(video: Path, work: Path, count: int | None, progress: Progress, upright: bool = True) -> Path:
    """Write `count` frames of a video, or one per STRIDE of motion, as JPEGs to the folder `images` in the work folder,
    which is whole or not there: frame_000012.jpg is number 12, counted from 0. They are turned `upright`, or as they
    are stored.

    Raises:
        CaptureError: it cannot be read, or nothing moves in it.
    """
    target = work / IMAGES
    if target.is_dir():
        return target
    seen, motion, sharp = _survey(video, progress)
    if len(seen) < 3:
        raise CaptureError(
            f"{video} holds {len(seen)} frames: film for at least ten seconds while you walk round the scene"
        )
    if motion[-1] < STILL:
        raise CaptureError(
            f"{video} shows no motion: its frames are all alike. Film while you walk slowly round the scene, and turn "
            "the camera to keep it in view"
        )
    wanted = count or int(np.clip(round(motion[-1] / STRIDE), FEWEST, MOST))
    chosen = choose(np.array(motion), np.array(sharp), wanted)
    numbers = {seen[i] for i in chosen}
    with complete_folder(target) as folder:
        shape = _shape_of_pixels(video)
        wanted_frames = islice((each for each in _frames(video) if each[0] in numbers), len(numbers))
        for written, (number, frame, turn) in enumerate(wanted_frames, 1):
            image = _upright(frame, turn if upright else 0, shape)
            image.save(folder / f"frame_{number:06d}.jpg", quality=JPEG_QUALITY, subsampling=0)
            progress("writing frames", written, len(numbers))
    return target


def choose(motion: np.ndarray, sharp: np.ndarray, count: int) -> list[int]:
    """Choose the sharpest frame of each of `count` stretches of equal motion, by motion from the start [n], not
    decreasing, and sharpness [n]; stretches without a frame give none."""
    stretch = np.minimum((motion / motion[-1] * count).astype(int), count - 1)
    return [int(i) for s in np.unique(stretch) for i in [np.flatnonzero(stretch == s)[sharp[stretch == s].argmax()]]]


def _survey(video: Path, progress: Progress) -> tuple[list[int], list[float], list[float]]:
    """Return the numbers of the surveyed frames, the motion up to each in units of the longer side, and sharpness."""
    seen: list[int] = []
    motion: list[float] = []
    sharp: list[float] = []
    before: np.ndarray | None = None
    last = -math.inf
    gap, rate, total = _pace(video)
    for number, frame, _ in _frames(video):
        time = number / rate if frame.time is None else frame.time
        if 0.0 <= time - last < gap:  # times that run backwards are no reason to pass over what follows
            continue
        last = time
        small = frame.reformat(*_size(frame, FINE), format="gray8").to_ndarray().astype(np.float32)
        sharp.append(sharpness(small) * float(np.sqrt(np.mean(np.diff(small, axis=1) ** 2))))
        factor = max(1, round(max(small.shape) / SMALL))
        rows, columns = (side // factor * factor for side in small.shape)
        tiny = small[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor).mean(axis=(1, 3))
        motion.append((motion[-1] if motion else 0.0) + (displacement(before, tiny) if before is not None else 0.0))
        before = tiny
        seen.append(number)
        progress("watching the video", min(number, total), total)
    progress("watching the video", total, total)
    return seen, motion, sharp


def displacement(first: np.ndarray, second: np.ndarray) -> float:
    """Measure the mean displacement of image blocks by phase correlation, in units of the longer side; blocks without
    texture count as still."""
    size = max(16, min(first.shape) // 3)
    window = np.outer(np.hanning(size), np.hanning(size))
    lengths = []
    for top in np.linspace(0, first.shape[0] - size, 3).astype(int):
        for left in np.linspace(0, first.shape[1] - size, 3).astype(int):
            a, b = (image[top : top + size, left : left + size] for image in (first, second))
            if a.std() < 2.0 or np.abs(a - b).mean() < 0.02 * a.std():  # bare, or without motion beyond noise
                lengths.append(0.0)
                continue
            product = np.fft.rfft2((a - a.mean()) * window) * np.conj(np.fft.rfft2((b - b.mean()) * window))
            peak = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-6), s=(size, size))
            # a parabola through the peak and its neighbours finds shifts of less than a pixel.
            at = np.array(np.unravel_index(peak.argmax(), peak.shape))
            shift = [_between(peak[:, at[1]], at[0]), _between(peak[at[0]], at[1])]
            shift = [s - size if s > size / 2 else s for s in shift]
            lengths.append(float(np.hypot(*shift)))
    return float(np.mean(lengths)) / max(first.shape)


def _between(line: np.ndarray, at: int) -> float:
    """Position of the peak of a parabola through three values of a periodic line."""
    low, mid, high = line[at - 1], line[at], line[(at + 1) % len(line)]
    curve = low - 2 * mid + high
    return float(at + (0.5 * (low - high) / curve if curve < 0 else 0.0))


def _pace(video: Path) -> tuple[float, float, int]:
    """Return the least seconds between surveyed frames, the mean frame rate, and the approximate number of frames."""
    with _opened(video) as container:
        stream = _pictures(container)
        rate = float(stream.average_rate or 30)
        length = float(container.duration or 0) / 1e6
        total = max(1, stream.frames or round(rate * length))
        gap = min(1.0 / PER_SECOND, total / rate / LEAST_SURVEYED)
        return gap - 0.5 * min(gap, 1.0 / rate), rate, total  # the nearest frame to the due time, not the next one


def _opened(video: Path) -> av.container.InputContainer:
    try:
        open_regular(video).close()
        container = av.open(os.path.abspath(video), options=TRUSTED)  # a relative one may begin like an address
    except (av.FFmpegError, OSError, ValueError) as error:
        raise CaptureError(
            f"{video} cannot be read as a video ({error.strerror or error}): record or export it again"
        ) from error
    if not container.streams.video:
        container.close()
        raise CaptureError(f"{video} holds no pictures, only sound: name another file")
    return container


def _pictures(container: av.container.InputContainer) -> av.VideoStream:
    """Choose the video stream; in some files a cover picture is the first."""
    return container.streams.best("video") or container.streams.video[0]


def _frames(video: Path) -> Iterator[tuple[int, av.VideoFrame, int]]:
    """Yield number, frame and display rotation in degrees; a broken end is skipped."""
    with _opened(video) as container:
        stream = _pictures(container)
        stream.thread_type = "AUTO"
        number = 0
        try:
            for frame in container.decode(stream):
                yield number, frame, int(frame.rotation)
                number += 1
        except av.FFmpegError as error:
            if number == 0:
                raise CaptureError(
                    f"{video} cannot be decoded ({error.strerror}): record or export it again"
                ) from error


def _size(frame: av.VideoFrame, longer: int) -> tuple[int, int]:
    scale = min(1.0, longer / max(frame.width, frame.height))
    return max(16, round(frame.width * scale)), max(16, round(frame.height * scale))


def _shape_of_pixels(video: Path) -> float:
    """Return the pixel aspect ratio, which is not 1 for some camcorders and anamorphic lenses."""
    with _opened(video) as container:
        shape = float(_pictures(container).sample_aspect_ratio or 1.0)
    return shape if 0.25 < shape < 4.0 else 1.0


def _upright(frame: av.VideoFrame, turn: int, shape: float = 1.0) -> Image.Image:
    """Rotate a frame upright by `turn` degrees counter-clockwise (ffmpeg's display matrix), with square pixels; `shape`
    is the pixel aspect ratio."""
    image = tone_mapped(frame) if is_hdr(frame) else frame.to_image()
    if shape != 1.0:  # cameras of COLMAP with one focal length have square pixels
        image = image.resize((round(image.width * shape), image.height), Image.Resampling.LANCZOS)
    return image.rotate(turn, expand=True) if turn % 360 else image
