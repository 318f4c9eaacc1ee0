"""Frames of a video: the sharpest of each stretch of equal camera motion, tone mapped from high dynamic range."""

import math
import os
from bisect import bisect_left, insort
from collections.abc import Generator, Iterator
from itertools import islice
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from av.container import InputContainer
from PIL import Image, ImageOps

from bitymi_ns.files import Tell, complete_folder
from bitymi_ns.progress import Progress
from bitymi_ns.safe_reading import open_regular
from .cache import content_key, made_once
from .sfm_photos import IMAGES, JPEG_QUALITY, sharpness
from .types import fail, warn

SMALL = 160  # longer side of frames for measuring motion, pixels
FINE = 640  # longer side of frames for measuring sharpness, pixels
STRIDE = 0.08  # between extracted frames, in longer sides: neighbors share about 90 %
FEWEST, MOST = 20, 300  # frames of a video whose camera moves
STILL = 0.02  # least motion over a video, in longer sides
PER_SECOND = 15  # frames surveyed per second of timestamps: the rate of phones varies with the light
TRUSTED = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,mpegvideo",
    "protocol_whitelist": "file",
}
"""FFmpeg options: a file of any name may be a list of files and URLs to read."""
LEAST_SURVEYED = 60  # all of a clip of a second or two
NO_MOTION = "shows no motion: its frames are all alike. Film while you walk slowly round the scene"
PQ, HLG = 16, 18  # transfer functions of high dynamic range (ITU-T H.273)
BT2020 = 9  # matrix of luma and chroma of such films
WHITE = 203.0  # cd/m^2 of white paper (ITU-R BT.2408), which becomes a screen's white
HLG_PEAK, HLG_GAMMA = 1000.0, 1.2  # of HLG's reference display (ITU-R BT.2100)
KNEE = 0.8  # share of white from which light is compressed to white
LUMA = np.array([0.2627, 0.6780, 0.0593])  # luma coefficients of BT.2020
TO_709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
"""BT.2020's linear red, green and blue to those of BT.709 and sRGB."""


def frames_with_poses(video: Path, poses: int, progress: Progress, tell: Tell) -> Path:
    """Write the frames of a video with `poses` known poses beside it. Raises CaptureError: their numbers differ."""

    def extract(work: Path) -> None:
        total = _pace(video)[2]
        if abs(total - poses) > max(2, poses // 100):
            advice = f"Export the capture again, or compute poses: `bitymi-data --data {video}`"
            fail(f"{video} has {total} frames, but {poses} poses. {advice}")
        extract_frames(video, work, None, progress, upright=False)

    return made_once(video.parent, content_key([(video.name, video)], "frames"), "frames", tell, extract) / IMAGES


def extract_frames(video: Path, work: Path, count: int | None, progress: Progress, upright: bool = True) -> Path:
    """Write `count` frames of a video, or one per STRIDE of motion, `upright` or as stored, to `images` in the work
    folder: frame_000012.jpg is number 12, from 0. Raises CaptureError: nothing moves in it."""
    target = work / IMAGES
    if target.is_dir():
        return target
    seen, motion, sharp = _survey(video, progress)
    if len(seen) < 3:
        fail(f"{video} has too few frames ({len(seen)}): film for ten seconds, walking round the scene")
    if motion[-1] < STILL:
        fail(f"{video} {NO_MOTION}")
    wanted = count or int(np.clip(round(motion[-1] / STRIDE), FEWEST, MOST))
    numbers = {seen[i] for i in choose(np.array(motion), np.array(sharp), wanted)}
    with complete_folder(target) as folder:
        with _opened(video) as container:  # pixels may not be square
            shape = float(_pictures(container).sample_aspect_ratio or 1.0)
            shape = shape if 0.25 < shape < 4.0 else 1.0
        chosen_frames = islice(((i, frame) for i, frame in _frames(video) if i in numbers), len(numbers))
        for written, (number, frame) in enumerate(chosen_frames, 1):
            image = _picture(frame, shape)
            if upright and (matrix := frame.side_data.get("DISPLAYMATRIX")) is not None:
                a, b, c, d = (np.frombuffer(matrix, np.int32)[[0, 1, 3, 4]] / 65536.0).round(2).tolist()
                if (abs(a), abs(b), abs(c), abs(d)) in ((1, 0, 0, 1), (0, 1, 1, 0)):  # to x' = ax + cy, y' = bx + dy
                    image = image if a else image.transpose(Image.Transpose.TRANSPOSE)
                    image = ImageOps.mirror(image) if a + c < 0 else image
                    image = ImageOps.flip(image) if b + d < 0 else image
                elif written == 1:
                    warn(f"{video} is taken as stored: its display matrix ({a}, {b}, {c}, {d}) is no turn or mirror.")
            image.save(folder / f"frame_{number:06d}.jpg", quality=JPEG_QUALITY, subsampling=0)
            progress("writing frames", written, len(numbers))
    return target


def choose(motion: np.ndarray, sharp: np.ndarray, count: int) -> list[int]:
    """Choose the sharpest frame of each of `count` stretches of equal motion, by motion from the start [n]."""
    stretch = np.minimum((motion / motion[-1] * count).astype(int), count - 1)
    return [int(i) for s in np.unique(stretch) for i in [np.flatnonzero(stretch == s)[sharp[stretch == s].argmax()]]]


def _survey(video: Path, progress: Progress) -> tuple[list[int], list[float], list[float]]:
    """Survey frames: their numbers, motion up to each in longer sides, and sharpness."""
    seen: list[int] = []
    motion: list[float] = []
    sharp: list[float] = []
    before, last = None, -math.inf
    gap, rate, total = _pace(video)
    for number, frame in _frames(video):
        time = number / rate if frame.time is None else frame.time
        if 0.0 <= time - last < gap:  # times may run backwards
            continue
        last = time
        scale = min(1.0, FINE / max(frame.width, frame.height))
        size = (max(16, round(side * scale)) for side in (frame.width, frame.height))
        small = frame.reformat(*size, format="gray8").to_ndarray().astype(np.float32)
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
    """Measure the mean displacement of image blocks by phase correlation, in longer sides; bare ones are still."""
    if first.shape != second.shape:
        return 0.0
    height, width = np.minimum(max(16, min(first.shape) // 3), first.shape)
    window = np.outer(np.hanning(height), np.hanning(width))
    lengths = []
    for top in np.linspace(0, first.shape[0] - height, 3).astype(int):
        for left in np.linspace(0, first.shape[1] - width, 3).astype(int):
            a, b = (image[top : top + height, left : left + width] for image in (first, second))
            if a.std() < 2.0 or np.abs(a - b).mean() < 0.02 * a.std():  # bare, or without motion beyond noise
                lengths.append(0.0)
                continue
            product = np.fft.rfft2((a - a.mean()) * window) * np.conj(np.fft.rfft2((b - b.mean()) * window))
            peak = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-6), s=window.shape)
            # finds parts of a pixel
            row, column = map(int, np.unravel_index(peak.argmax(), peak.shape))
            shift = (_between(peak[:, column], row), _between(peak[row], column))
            lengths.append(math.hypot(*(s - n * (s > n / 2) for s, n in zip(shift, window.shape, strict=True))))
    return float(np.mean(lengths)) / max(first.shape)


def _between(line: np.ndarray, i: int) -> float:
    """Locate the peak of a parabola through three values of a periodic line."""
    low, mid, high = line[i - 1], line[i], line[(i + 1) % len(line)]
    curve = low - 2 * mid + high
    return float(i + (0.5 * (low - high) / curve if curve < 0 else 0.0))


def _pace(video: Path) -> tuple[float, float, int]:
    """Return the least seconds between surveyed frames, mean frame rate, and approximate number of frames."""
    with _opened(video) as container:
        stream = _pictures(container)
        rate = float(stream.average_rate or 30)
        length = float(container.duration or 0) / 1e6
        total = max(1, stream.frames or round(rate * length))
        gap = min(1.0 / PER_SECOND, total / rate / LEAST_SURVEYED)
        return gap - 0.5 * min(gap, 1.0 / rate), rate, total  # the nearest frame to the due time, not the next one


def _opened(video: Path) -> InputContainer:
    try:
        open_regular(video).close()
        container = av.open(os.path.abspath(video), options=TRUSTED)  # a relative path may begin like a URL
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        fail(f"{video} cannot be read as a video ({reason}): record or export it again", error)
    if not container.streams.video:
        container.close()
        fail(f"{video} holds no pictures, only sound: name another file")
    return container


def _pictures(container: InputContainer) -> av.VideoStream:
    """Choose the video stream, not a cover picture."""
    best = container.streams.best("video")
    return best if isinstance(best, av.VideoStream) else container.streams.video[0]


def _frames(video: Path) -> Iterator[tuple[int, av.VideoFrame]]:
    """Yield number, by the timestamps of all, and frame. Damaged frames and those drawn from them, up to the next key
    frame, are left out; at the end, a line says how many. Raises CaptureError: there are no others."""
    line, last, lost = yield from _decoded(video, "AUTO", -1)
    if lost:  # threads with a frame each lose some behind damage near the end
        again, last, _ = yield from _decoded(video, "SLICE", last)
        line = again or line
    if line and last < 0:
        fail(f"{line} Record or export it again.")
    if line:
        warn(f"{line} Copy it again if you can.")


def _decoded(video: Path, threads: str, last: int) -> Generator[tuple[int, av.VideoFrame], None, tuple[str, int, bool]]:
    """Yield the frames behind number `last`; return a line on damage ("" = none), the last number, and if some lack."""
    with _opened(video) as container:
        stream = _pictures(container)
        stream.thread_type = threads
        stamps: list[int] = []  # of the packets
        number, whole, damage, end = -1, True, "", 0.0
        good, bad, packets, hidden = 0, 0, -1, 0  # the last packet is empty
        try:
            for packet in container.demux(stream):
                packets, hidden = packets + 1, hidden + packet.is_discard
                if packet.pts is not None and not packet.is_discard:
                    insort(stamps, packet.pts)
                damage = damage or "it is cut off" * packet.is_corrupt
                try:
                    frames = packet.decode()
                except av.FFmpegError as error:
                    whole, damage, bad = False, error.strerror, bad + 1
                    continue
                for frame in frames:
                    damage = damage or "its frames are damaged" * frame.is_corrupt
                    whole = not frame.is_corrupt and (whole or frame.key_frame)
                    bad += not whole
                    if whole:
                        number = max(number + 1, 0 if frame.pts is None else bisect_left(stamps, frame.pts))
                        good, end = good + 1, frame.time or 0.0
                        if number > last:
                            yield number, frame
        except av.FFmpegError as error:
            damage = error.strerror
        stated = stream.frames if container.format.name == "avi" else len(stream.index_entries)
        lost = stated - hidden - good if stated >= packets else bad  # a frame may have a packet per field
        line = ""
        if damage and not good:
            line = f"{video} cannot be decoded: {damage}."
        elif lost > 0 and (damage or stated > packets):
            line = f"{video} is damaged: {lost} of its {good + lost} frames are left out."
        elif "matroska" in container.format.name and end < (length := (container.duration or 0) / 1e6) - 1.0:
            line = f"{video} ends early: its pictures last {end:.1f} of {length:.1f} seconds."
        return line, number, lost > 0


def _picture(frame: av.VideoFrame, shape: float = 1.0) -> Image.Image:
    """Convert a frame to a picture with square pixels; `shape` is the pixel aspect ratio."""
    image = tone_mapped(frame) if getattr(frame, "color_trc", None) in (PQ, HLG) else frame.to_image()
    if shape != 1.0:  # cameras of COLMAP with one focal length have square pixels
        image = image.resize((max(1, round(image.width * shape)), image.height), Image.Resampling.LANCZOS)
    return image


def tone_mapped(frame: av.VideoFrame) -> Image.Image:
    """Convert a high dynamic range frame to 8-bit sRGB."""
    frame.colorspace = BT2020  # some cameras do not state it
    signal = frame.to_ndarray(format="rgb48le").astype(np.float32) / 65535.0
    nits = pq_to_nits(signal) if frame.color_trc == PQ else hlg_to_nits(signal)
    light = nits @ TO_709.T / WHITE
    brightest = np.maximum(light.max(-1, keepdims=True), 1e-6)
    rest = 1.0 - KNEE
    beyond = KNEE + rest * (1.0 - np.exp(-np.maximum(brightest - KNEE, 0.0) / rest))
    light = np.clip(light * np.where(brightest <= KNEE, 1.0, beyond / brightest), 0.0, 1.0)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return Image.fromarray(np.uint8(srgb * 255.0 + 0.5))


def pq_to_nits(signal: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Convert a PQ signal in [0, 1] to display light in cd/m^2 (ITU-R BT.2100)."""
    m1 = 2610 / 16384
    m2 = 2523 / 4096 * 128
    c1 = 3424 / 4096
    c2 = 2413 / 4096 * 32
    c3 = 2392 / 4096 * 32
    power = np.maximum(signal, 0.0) ** (1.0 / m2)
    return 10_000.0 * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1.0 / m1)


def hlg_to_nits(signal: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Convert an HLG signal [..., 3] in [0, 1] to display light in cd/m^2."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)
    luminance = np.maximum(scene @ LUMA, 1e-6)[..., None]
    return HLG_PEAK * luminance ** (HLG_GAMMA - 1.0) * scene
