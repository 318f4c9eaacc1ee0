"""Read COLMAP models. pycolmap accepts truncated files, ends names at the first space, and needs points."""

import errno
import functools
import math
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bitymi_ns.safe_reading import open_text, read_bytes
from bitymi_ns.trust import listed
from . import pycolmap
from .points import color_bytes, read_cloud
from .recognise import image_count
from .transforms import MAX_SIDE
from .types import SPHERICAL_MODEL, ColmapCamera, fail, parsing, warn

FORMS = (".txt", ".bin")
MOST_MODEL = 1 << 36  # bytes of a file; 100 million points take a twentieth of it
PROBE = 1 << 20
TINY = 1e-100  # least length of a quaternion that can be normalised
CAMERA_SENSOR = int(pycolmap.SensorType.CAMERA)


class ModelImage(NamedTuple):
    name: str
    camera_id: int
    qvec: npt.NDArray[np.float64]  # world to camera, wxyz
    tvec: npt.NDArray[np.float64]
    frame: int | None = None  # of its rig; None = no rig


class Model(NamedTuple):
    cameras: dict[int, ColmapCamera]  # by number
    images: list[ModelImage]  # sorted by name
    xyz: npt.NDArray[np.float64]  # [N, 3] in COLMAP's world
    rgb: npt.NDArray[np.uint8]  # [N, 3], or [0, 3] without colors
    without_colors: str = ""  # why, in words that follow the file's name


def read_model(folder: Path) -> Model:
    """Read a model, of both forms the text; warn if they differ. Raises CaptureError: it cannot be used."""
    path = _file(folder, "cameras")
    cameras = dict(_parsed(path))
    _check_cameras(path, cameras)
    path = _file(folder, "images")
    images = dict(_parsed(path))
    _check_images(path, images, cameras)
    path = path.with_stem("frames")
    if path.is_file():  # of COLMAP 4
        frames = dict(_parsed(path))
        images = {number: image._replace(frame=frames.get(number)) for number, image in images.items()}
    _warn_of_other_form(folder, cameras, len(images))
    path = _file(folder, "points3D")
    xyz, rgb, without_colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), ""
    if path.is_file():
        xyz, rgb, without_colors = _parsed(path)
        finite = np.isfinite(xyz).all(1)
        if not finite.all():
            first = f"the first is point {np.argmin(finite) + 1}"
            warn(f"{path}: {np.sum(~finite):,} of {len(xyz):,} points, {first}, are not finite. They are left out.")
            xyz, rgb = xyz[finite], rgb[finite] if len(rgb) else rgb
    if not len(xyz) and (cloud := folder / "points3D.ply").is_file():
        (xyz, rgb), without_colors = read_cloud(cloud, "Copy it again, or move it away to have points triangulated.")
    # nerfstudio sorts paths, not text: alike, the same photographs are held out
    return Model(cameras, sorted(images.values(), key=lambda image: Path(image.name)), xyz, rgb, without_colors)


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a binary model and read it back, as COLMAP ignores failed writes; by this reader, as COLMAP's
    does not end on some truncated files. Raises OSError: a file is incomplete."""
    try:
        model.write_binary(folder)
        for name, read in BINARY.items():
            tuple(read(folder / f"{name}.bin"))
    except (ValueError, struct.error) as error:
        for name in BINARY:  # write more to have the reason reported
            with open(folder / f"{name}.bin", "ab") as file:
                file.write(bytes(PROBE))
                file.flush()
                os.fsync(file.fileno())
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(folder)) from error


def _file(folder: Path, name: str) -> Path:
    """Choose the text or binary file of a model: of the form with cameras and images, else the text."""

    def is_complete(form: str) -> bool:
        return all((folder / f"{part}{form}").is_file() for part in ("cameras", "images"))

    preferred = sorted(FORMS, key=is_complete, reverse=True)
    return next((file for form in preferred if (file := folder / f"{name}{form}").is_file()), folder / f"{name}.bin")


def _warn_of_other_form(folder: Path, cameras: dict[int, ColmapCamera], images: int) -> None:
    if _file(folder, "images").suffix != ".txt" or not (folder / "images.bin").is_file():
        return
    count, path = image_count(folder), folder / "cameras.bin"
    if count != images or (path.is_file() and dict(_parsed(path)) != cameras):
        warn(
            f"{folder} holds two models, of {images} images in text and {count} in binary form, or of other cameras. "
            "The text is read: move cameras.txt, images.txt and points3D.txt away to have the binary one read."
        )


def _parsed(path: Path) -> list[Any]:
    if not os.path.lexists(path):
        fail(f"the COLMAP model lacks {path}. Copy the whole model: cameras, images and points3D.")
    hint = "It is cut off or damaged. " * (path.suffix == ".bin")
    hint += "Each image has two lines; the second, of its 2D points, may be empty. " * (path.name == "images.txt")
    with parsing(path, f"{hint}Copy or export the model again."):
        return list((TEXT if path.suffix == ".txt" else BINARY)[path.stem](path))


@functools.cache
def parameter_count(model: str) -> int | None:
    """Count a camera model's parameters; None = COLMAP has no such model."""
    if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
        return None
    return len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).params)


def _check_cameras(path: Path, cameras: dict[int, ColmapCamera]) -> None:
    for number, camera in cameras.items():
        count = parameter_count(camera.model)
        if not all(1 <= side <= MAX_SIDE for side in camera.size) or not np.isfinite(camera.params).all():
            what = f"{path}: camera {number}, {' '.join(str(part)[:99] for part in camera)}, cannot be used"
            fail(f"{what}: sides are 1 to {MAX_SIDE:,} pixels, numbers finite. Correct it.")
        if len(camera.params) != count:
            what = f"camera {number} has {len(camera.params)} parameters, but a {camera.model} has {count}"
            fail(f"{path}: {what}. Correct its line.")


def _check_images(path: Path, images: dict[int, ModelImage], cameras: dict[int, ColmapCamera]) -> None:
    if not images:
        fail(f"{path} lists no images: COLMAP found no poses. Give another model with `--colmap-path`.")
    first: dict[str, int] = {}
    for number, image in images.items():
        if image.camera_id not in cameras:
            what = f"image {number} ({image.name}) is of camera {image.camera_id}, but the model has only"
            fail(f"{path}: {what} {listed(sorted(cameras))}. Correct its line.")
        if not np.isfinite([*image.qvec, *image.tvec]).all() or not TINY < np.linalg.norm(image.qvec) < 1.0 / TINY:
            what = f"the pose of image {number} ({image.name}) is not finite, or its rotation is zero"
            fail(f"{path}: {what}. Correct its line or remove the image.")
        if first.setdefault(image.name, number) != number:
            twice = f"images {first[image.name]} and {number} are both of {image.name}"
            fail(f"{path}: {twice}. Correct one or remove it.")


class _Binary:
    """Sequential reader; raises errors if the file has less or more than it states."""

    def __init__(self, path: Path) -> None:
        self.data, self.offset = read_bytes(path, MOST_MODEL), 0

    def take(self, format: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + format, self.data, self.offset)
        self.skip(struct.calcsize("<" + format))
        return values

    def skip(self, size: int) -> None:
        self.offset += size
        if self.offset > len(self.data):
            raise ValueError("ends too early")

    def name(self) -> str:
        end = self.data.index(b"\0", self.offset)
        text = os.fsdecode(self.data[self.offset : end])
        self.skip(end + 1 - self.offset)
        return text

    def rows(self) -> Iterator["_Binary"]:
        for _ in range(self.take("Q")[0]):
            yield self
        if self.offset != len(self.data):
            raise ValueError("has more than it states")


def _cameras_binary(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for file in _Binary(path).rows():
        number, kind, width, height = file.take("IiQQ")
        name = pycolmap.CameraModelId(kind).name
        yield number, ColmapCamera(name, width, height, file.take(f"{parameter_count(name)}d"))


def _images_binary(path: Path) -> Iterator[tuple[int, ModelImage]]:
    for file in _Binary(path).rows():
        number, *pose, camera = file.take("I7dI")
        yield number, ModelImage(file.name(), camera, np.array(pose[:4]), np.array(pose[4:]))
        file.skip(24 * file.take("Q")[0])  # 2D points


def _rigs_binary(path: Path) -> Iterator[int]:
    for file in _Binary(path).rows():
        number, sensors = file.take("II")
        file.skip(8 * (sensors > 0))  # the reference sensor
        for _ in range(sensors - 1):
            file.skip(56 * file.take("iIB")[-1])  # a pose, if it has one
        yield number


def _frames_binary(path: Path) -> Iterator[tuple[int, int]]:
    for file in _Binary(path).rows():
        frame, *_, count = file.take("II7dI")  # rig and pose between
        for _ in range(count):
            sensor, _, number = file.take("iIQ")
            if sensor == CAMERA_SENSOR:
                yield number, frame


def _points_binary(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], str]:
    file, starts = _Binary(path), []
    for _ in file.rows():
        starts.append(file.offset)
        file.skip(43)  # number, position, color, error
        file.skip(8 * file.take("Q")[0])  # track
    rows = np.frombuffer(file.data, np.uint8)[np.array(starts, int)[:, None] + np.arange(8, 35)]
    return rows[:, :24].copy().view("<f8").reshape(-1, 3), rows[:, 24:].copy(), ""


def _lines(path: Path) -> Iterator[str]:
    with open_text(path, errors="surrogateescape") as file:
        for line in file:
            if not line.startswith("#"):
                yield line.strip()


def _cameras_text(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for line in filter(None, _lines(path)):
        number, model, width, height, *params = line.split()
        if model == "SPHERE":  # SphereSfM's name
            model, params = SPHERICAL_MODEL, [width, height]
        if parameter_count(model) is None:
            raise ValueError(f"COLMAP has no camera model {model}")
        yield int(number), ColmapCamera(model, int(width), int(height), tuple(map(float, params)))


def _images_text(path: Path) -> Iterator[tuple[int, ModelImage]]:
    """Parse images.txt; some programs leave out the second line of an image."""
    number = None
    for line in _lines(path):
        if number is not None and _are_observations(line):
            number = None
        elif line:
            words = line.split(maxsplit=9)
            if number is not None and len(words) < 10:
                raise ValueError(f"the 2D points of image {number} are no triples")
            number, *pose, camera, name = words
            if len(pose) != 7:
                raise ValueError(f"image {number} has {len(pose)} numbers for its pose instead of 7")
            numbers = np.array(list(map(float, pose)))
            yield int(number), ModelImage(name, int(camera), numbers[:4], numbers[4:])


def _frames_text(path: Path) -> Iterator[tuple[int, int]]:
    for line in filter(None, _lines(path)):
        words = line.split()
        if len(words) < 10:
            raise ValueError(f"the line of frame {words[0]} is cut off")
        frame, count, data = int(words[0]), int(words[9]), words[10:]
        if len(data) != 3 * count:
            raise ValueError(f"frame {frame} states {count} images and lists {len(data) / 3:g}")
        yield from ((int(number), frame) for sensor, number in zip(data[::3], data[2::3], strict=True)
                    if sensor == "CAMERA")  # fmt: skip


def _are_observations(line: str) -> bool:
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def _points_text(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], str]:
    rows = [[float(word) for word in line.split(maxsplit=7)[1:7]] for line in _lines(path) if line]
    counts = {len(row) for row in rows}
    if not counts <= {3, 6} or len(counts) > 1:
        raise ValueError("a point has a number, three coordinates and three colors")
    if 6 not in counts:
        return np.array(rows).reshape(-1, 3), np.zeros((0, 3), np.uint8), "its points have none" * bool(rows)
    values = np.array(rows)
    return values[:, :3], *color_bytes(values[:, 3:], bool((values[:, 3:] % 1.0).any()))


# Readers of files by name.
Reader = Callable[[Path], Iterable[Any]]
TEXT: dict[str, Reader] = {
    "cameras": _cameras_text, "frames": _frames_text, "images": _images_text, "points3D": _points_text,
}  # fmt: skip
BINARY: dict[str, Reader] = {
    "rigs": _rigs_binary, "cameras": _cameras_binary, "frames": _frames_binary, "images": _images_binary,
    "points3D": _points_binary,
}  # fmt: skip
